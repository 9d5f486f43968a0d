"""What changes or picks genomes without a gradient."""
