"""NEAT of neat-python: generations per CPU second on Sequence Recall, 100 networks × 10 sequences.

Run by the benchmarks in an environment that has neat-python: `python neat_python.py SEQUENCES
GENERATIONS`; SEQUENCES is a file of JSON: lists of [inputs, target, scored], one a step.
Prints a JSON line. Networks are its recurrent ones; settings are its defaults for XOR, but for the
population, the numbers of inputs and outputs, and recurrent connections.
"""

import json
import sys
import tempfile
import time

import neat

SETTINGS = """
[NEAT]
fitness_criterion = max
fitness_threshold = 1e9
pop_size = 100
reset_on_extinction = True
no_fitness_termination = True

[DefaultGenome]
activation_default = sigmoid
activation_mutate_rate = 0.0
activation_options = sigmoid
aggregation_default = sum
aggregation_mutate_rate = 0.0
aggregation_options = sum
bias_init_mean = 0.0
bias_init_stdev = 1.0
bias_init_type = gaussian
bias_max_value = 30.0
bias_min_value = -30.0
bias_mutate_power = 0.5
bias_mutate_rate = 0.7
bias_replace_rate = 0.1
compatibility_disjoint_coefficient = 1.0
compatibility_excess_coefficient = 1.0
compatibility_weight_coefficient = 0.5
conn_add_prob = 0.05
conn_delete_prob = 0.0
enabled_default = True
enabled_mutate_rate = 0.01
enabled_rate_to_true_add = 0.0
enabled_rate_to_false_add = 0.0
feed_forward = False
initial_connection = full_direct
node_add_prob = 0.03
node_delete_prob = 0.0
num_hidden = 0
num_inputs = 2
num_outputs = 1
response_init_mean = 1.0
response_init_stdev = 0.0
response_init_type = gaussian
response_max_value = 30.0
response_min_value = -30.0
response_mutate_power = 0.0
response_mutate_rate = 0.0
response_replace_rate = 0.0
single_structural_mutation = false
structural_mutation_surer = default
weight_init_mean = 0.0
weight_init_stdev = 1.0
weight_init_type = uniform
weight_max_value = 30
weight_min_value = -30
weight_mutate_power = 0.5
weight_mutate_rate = 0.8
weight_replace_rate = 0.1

[DefaultSpeciesSet]
compatibility_threshold = 3.0

[DefaultStagnation]
species_fitness_func = max
max_stagnation = 15
species_elitism = 1

[DefaultReproduction]
elitism = 1
survival_threshold = 0.2
min_species_size = 2
"""


def main(path, generations):
    with open(path) as file:
        sequences = json.load(file)

    def evaluate(genomes, config):
        for _, genome in genomes:
            network, total = neat.nn.RecurrentNetwork.create(genome, config), 0.0
            for sequence in sequences:
                network.reset()
                for inputs, target, scored in sequence:
                    (answer,) = network.activate(inputs)
                    if scored:
                        total += (answer > 0.5) == (target > 0)
            genome.fitness = total / len(sequences)

    with tempfile.NamedTemporaryFile("w", suffix=".ini") as file:
        file.write(SETTINGS)
        file.flush()
        kinds = (neat.DefaultGenome, neat.DefaultReproduction)
        kinds += (neat.DefaultSpeciesSet, neat.DefaultStagnation)
        config = neat.Config(*kinds, file.name)
    population = neat.Population(config)
    population.run(evaluate, 1)
    begun = time.process_time()
    population.run(evaluate, generations)
    rate = generations / (time.process_time() - begun)
    print(json.dumps({"generations per CPU second": rate}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
