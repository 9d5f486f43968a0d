"""Episodes of rovers that play in the browser: one page, without a network.

Drag the time, choose a rover, see what its sensors said and who was within reach of which POI.
"""

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from ..compilation import jit
from ..environments.base import AbstractEnvironment
from ..environments.rover import BRACKETS, Rover
from ..networks.base import AbstractPolicy
from ..rollout import world_keys
from ..runs import files
from ..types import TimeStep
from .pages import render
from .sections import Page

SPEEDS = (1, 2, 5, 10, 20)  # steps per second to choose from


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode as it was played. `frames`: the start, and one more for every step."""

    name: str
    position: np.ndarray  # [frames, rovers, 2], m
    heading: np.ndarray  # [frames, rovers], rad, anticlockwise from +x
    poi: np.ndarray  # [pois, 2], m
    observed: np.ndarray  # [frames, pois], bool
    inside: np.ndarray  # [frames, pois]: rovers within the activation distance
    share: np.ndarray  # [frames]: what the global reward would be if the episode ended here
    sensors: np.ndarray  # [frames, rovers, 2, 36]: other rovers, POIs; as in an observation
    rewards: dict[str, np.ndarray]  # [frames] or [frames, rovers], paid by that step; first 0


def record(
    env: AbstractEnvironment, policy: AbstractPolicy, *, key: PRNGKeyArray
) -> tuple[PyTree, TimeStep]:
    """The episode that `evaluate(env, tree.stack(policy), 1, key=key)` plays, with its states.

    **Returns:** states and time steps, leaves `[steps + 1, ...]` in NumPy: as reset made them, and
    after every step up to the one that ended the episode.
    """
    played = _record(env, policy, key=key)
    states, seen = jax.tree.map(np.asarray, played)
    ends = seen.terminated | seen.truncated
    last = int(np.argmax(ends)) if ends.any() else len(ends) - 1
    return jax.tree.map(lambda x: x[: last + 1], (states, seen))


@jit
def _record(env: AbstractEnvironment, policy: AbstractPolicy, *, key: PRNGKeyArray):
    world_key, policy_key = jax.random.split(key)
    reset_key, step_key = jax.random.split(world_keys(1, 1, True, key=world_key)[0, 0])
    state, first = env.reset(key=reset_key)
    carry = policy.start(key=jax.random.split(policy_key, (1, 1))[0, 0])

    def advance(loop, t):
        state, obs, carry = loop
        action, carry = policy(obs, carry)
        action = jnp.clip(jnp.where(jnp.isfinite(action), action, 0.0), -1.0, 1.0)
        state, seen = env.step(state, action, key=jax.random.fold_in(step_key, t))
        return (state, seen.obs, carry), (state, seen)

    _, later = jax.lax.scan(advance, (state, first.obs, carry), jnp.arange(env.max_steps))
    return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), (state, first), later)


def play(env: Rover, policy: AbstractPolicy, seeds: Iterable[int]) -> list[Episode]:
    """One episode for each seed."""
    return [_played(env, policy, seed) for seed in seeds]


def _played(env: Rover, policy: AbstractPolicy, seed: int) -> Episode:
    states, seen = record(env, policy, key=jax.random.key(seed))
    paid = states.observed.astype(np.float32)
    if states.nearness is not None:
        paid = np.maximum(paid, states.nearness)
    way = states.poi[:, None] - states.position[:, :, None]  # [frames, rovers, pois, 2]
    near = np.sqrt(np.sum(way**2, axis=3)) <= np.float32(env.activation_distance)
    start = 0 if env.observation == "relative" else 1  # of the first ring
    rings = np.asarray(seen.obs)[:, :, start : start + 2 * BRACKETS]
    return Episode(
        f"seed {seed}",
        states.position,
        states.heading,
        states.poi[0],
        states.observed,
        near.sum(axis=1),
        paid @ np.asarray(env.values),
        rings.reshape(*rings.shape[:2], 2, BRACKETS),
        {name: np.asarray(seen.rewards[name]) for name in env.signals},
    )


def write(
    env: Rover,
    episodes: Sequence[Episode],
    path: str | os.PathLike[str],
    *,
    title: str,
    lead: str = "",
    speed: float = 5,
) -> Path:
    """Write a page with a player of these episodes to `path` and return it. A reader never sees
    half a file. Arguments and errors otherwise as of `player`."""
    path = Path(path)
    page = render(Page(title, lead, command="", sections=[]))
    text = page.replace("</main>", f"{player(env, episodes, speed=speed)}\n</main>")
    files.write_text(path, text)
    return path


def player(env: Rover, episodes: Sequence[Episode], *, speed: float = 5) -> str:
    """HTML that plays the episodes; part of a page with the style of `credo.report.pages`. Several
    can stand in one page.

    **Arguments:** `speed`: steps per second at first, more than 0.

    **Raises:** `ValueError` if there is no episode, or a number in one is not finite.
    """
    if not episodes:
        raise ValueError("there is no episode to play: give at least one")
    # Inside a script element "<" could end it.
    data = json.dumps(_data(env, episodes), separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c")
    speeds = sorted({*SPEEDS, float(f"{speed:g}")})
    options = {
        "episode": [episode.name for episode in episodes],
        "rover": [f"{i}" for i in range(env.agents)],
        "speed": [f"{s:g} steps/s" for s in speeds],
    }
    chosen = {"speed": speeds.index(float(f"{speed:g}"))}
    selects = "".join(
        f'<label>{name.capitalize()} <select class="{name}">'
        + "".join(
            f'<option value="{speeds[i] if name == "speed" else i}"'
            f"{' selected' if i == chosen.get(name) else ''}>{escape(label)}</option>"
            for i, label in enumerate(labels)
        )
        + "</select></label>"
        for name, labels in options.items()
    )
    return (
        f"<style>{STYLE}</style>\n"
        f'<section class="replay" aria-label="Replay of rovers">{LAYOUT.replace("@", selects)}'
        f'<script type="application/json">{data}</script></section>\n'
        f"<script>{SCRIPT}</script>"
    )


def _data(env: Rover, episodes: Sequence[Episode]) -> dict[str, Any]:
    return {
        "size": _short(np.float32(env.size)),
        "activation_distance": _short(np.float32(env.activation_distance)),
        "coupling": env.coupling,
        "observation": env.observation,
        "episodes": [
            {name: _short(value) for name, value in vars(episode).items()} for episode in episodes
        ],
    }


def _short(value: Any) -> Any:
    """Nested lists of the shortest numbers that are read back as the same 32 bits."""
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        return {name: _short(x) for name, x in value.items()}
    x = np.asarray(value)
    if not np.isfinite(x).all():
        raise ValueError("an episode holds a number that is not finite: it cannot be replayed")
    if x.dtype.kind != "f":
        return x.astype(int).tolist()
    if x.ndim:
        return [_short(row) for row in x] if x.ndim > 1 else [_number(s) for s in x.astype(str)]
    return _number(str(x))


def _number(text: str) -> float | int:
    number = float(text)
    return int(number) if number.is_integer() else number


LAYOUT = """
<div class="stage">
<svg class="field" role="img" aria-label="The field, seen from above"></svg>
<div class="bar">
<button type="button" class="play" aria-label="Play">&#9654;</button>
<input type="range" class="time" min="0" value="0" step="1" aria-label="Time step">
<span class="step" role="status"></span>
</div>
<div class="bar">@</div>
<p class="note keys">Space plays and pauses; left and right go a step, Home and End to the start and
the end, up and down to another rover. Click a rover to choose it.</p>
</div>
<div class="side">
<h2 class="who"></h2>
<svg class="sensors" viewBox="-100 -100 200 200" role="img"></svg>
<p class="note">Inner ring: <b class="others">other rovers</b>; outer ring: <b class="pois">POIs not
yet observed</b>, in 36 directions of the field. The longer a bar, the closer the target.</p>
<table class="rewards"><thead><tr><th scope="col">Reward</th><th scope="col" class="number">this
step</th><th scope="col" class="number">so far</th></tr></thead><tbody></tbody></table>
<p class="note total"></p>
<div class="running"></div>
<p class="note field-note"></p>
</div>
<noscript><p>The replay needs JavaScript.</p></noscript>
"""

STYLE = """
.replay {
  --seen: #c8102e; --poi: #1c1f23;
  --c0: #0072b2; --c1: #b84c00; --c2: #00785a; --c3: #a8467c; --c4: #8a6100; --c5: #2b7fb0;
  --c6: #5b5f66;
  margin-top: 1.5rem; display: grid; grid-template-columns: minmax(0, 1fr); gap: 1.5rem 2.5rem;
}
@media screen and (prefers-color-scheme: dark) {
  .replay {
    --seen: #ff6b78; --poi: #e4e7eb;
    --c0: #4aa3e6; --c1: #f07f3c; --c2: #22bd8f; --c3: #e097c2; --c4: #f2b441; --c5: #93d3f7;
    --c6: #c3c8cf;
  }
}
@media (min-width: 56rem) {
  /* The field, the controls below it and the panel beside it fit the window's height. */
  .replay { grid-template-columns: minmax(0, max(26rem, 100vh - 13rem)) 20rem; }
}
.replay svg { display: block; width: 100%; height: auto; }
.replay .field { border: 1px solid var(--line); border-radius: 6px; background: var(--box); }
.replay .field > * { vector-effect: non-scaling-stroke; }
.replay .ground { fill: var(--page); stroke: var(--muted); stroke-width: 1; }
.replay .grid { stroke: var(--line); stroke-width: 1; }
.replay .reach { fill: var(--poi); fill-opacity: .05; stroke: none; }
.replay .arc { fill: none; stroke: var(--muted); stroke-opacity: .4; stroke-width: 2; }
.replay .arc.lit { stroke: var(--poi); stroke-opacity: 1; stroke-width: 4; }
.replay .reach.seen { fill: var(--seen); fill-opacity: .1; }
.replay .arc.seen { stroke: var(--seen); stroke-opacity: 1; stroke-width: 1.5; }
.replay .dot { fill: var(--page); stroke: var(--poi); stroke-width: 2; }
.replay .dot.seen { fill: var(--seen); stroke: var(--seen); }
.replay text {
  font-family: inherit; fill: var(--ink); text-anchor: middle; paint-order: stroke;
  stroke: var(--page); stroke-width: 3px; stroke-linejoin: round;
}
.replay text.seen { fill: var(--seen); }
.replay .trail {
  fill: none; stroke-width: 1.5; stroke-opacity: .6; stroke-linejoin: round; pointer-events: none;
}
.replay .trail.chosen { stroke-width: 3; stroke-opacity: 1; }
.replay .rover { cursor: pointer; }
.replay .rover .hit { fill: transparent; }
.replay .rover .halo { fill: none; stroke: none; }
.replay .rover.chosen .halo { stroke: var(--ink); stroke-width: 1.5; }
.replay .rover .body { stroke: var(--page); stroke-width: 1; }
.replay .rover text { font-size: 11px; font-weight: 600; }
.replay .bar { display: flex; flex-wrap: wrap; align-items: center; gap: .5rem 1rem; }
.replay .bar { margin-top: .75rem; }
.replay .time { flex: 1 1 8rem; min-width: 6rem; height: 1.75rem; accent-color: var(--c0); }
.replay .step { min-width: 6.5rem; font-variant-numeric: tabular-nums; }
.replay button, .replay select {
  font: inherit; color: inherit; background: var(--box); border: 1px solid var(--muted);
  border-radius: 6px; min-height: 2.25rem;
}
.replay button { width: 3rem; cursor: pointer; }
.replay select { padding: 0 .4rem; margin-left: .25rem; max-width: 100%; }
.replay label { font-size: .9rem; }
.replay :focus-visible { outline: 2px solid var(--c0); outline-offset: 2px; }
.replay .keys { margin: .75rem 0 0; }
.replay .note { font-size: .9rem; line-height: 1.5; }
.replay .sensors { max-width: 20rem; margin: 0 auto .75rem; }
.replay .track { fill: var(--box); stroke: var(--line); stroke-width: .6; }
.replay .hole { fill: var(--page); stroke: var(--line); stroke-width: .6; }
.replay path.others { fill: var(--c0); }
.replay path.pois { fill: var(--c1); }
.replay b.others { color: var(--c0); }
.replay b.pois { color: var(--c1); }
.replay .running figure { margin: 0 0 .75rem; }
.replay .running figcaption { margin: 0; font-size: .85rem; color: var(--muted); }
.replay .running svg { height: 3.25rem; }
.replay .running * { vector-effect: non-scaling-stroke; }
.replay .later { fill: none; stroke: var(--line); stroke-width: 1.5; }
.replay .sofar { fill: none; stroke-width: 2; }
.replay .now { stroke: var(--muted); stroke-width: 1; }
.replay table { width: 100%; margin-bottom: .75rem; }
.replay th, .replay td { padding: .3rem .5rem; position: static; white-space: normal; }
"""

SCRIPT = """
(() => {
const root = document.currentScript.previousElementSibling;
const data = JSON.parse(root.querySelector('script').textContent);
const $ = name => root.querySelector(name);
const field = $('.field'), sensors = $('.sensors'), slider = $('.time'), button = $('.play');
const calm = matchMedia('(prefers-reduced-motion: reduce)');
const NS = 'http://www.w3.org/2000/svg', TURN = 2 * Math.PI, n = data.coupling;
let game, time = 0, rover = 0, playing = false, last = 0, view, parts, drawn = {};

function add(parent, tag, attributes) {
  const node = document.createElementNS(NS, tag);
  for (const name in attributes) node.setAttribute(name, attributes[name]);
  return parent.appendChild(node);
}
const set = (node, name, value) => node.setAttribute(name, value);
const number = x => (Math.abs(x) >= 100 ? x.toFixed(1) : x.toFixed(2)).replace('-', '\\u2212')
  .replace(/^\\u2212(0\\.0+)$/, '$1');
const at = (radius, angle) => `${radius * Math.cos(angle)} ${-radius * Math.sin(angle)}`;

/* A view that holds the field and whatever the rovers reached outside it; y points up. */
function frame() {
  const points = [[0, 0], [data.size, data.size], ...game.position.flat()];
  for (const [x, y] of game.poi)
    points.push([x - data.activation_distance, y - data.activation_distance],
                [x + data.activation_distance, y + data.activation_distance]);
  const low = [0, 1].map(k => points.reduce((m, p) => Math.min(m, p[k]), Infinity));
  const high = [0, 1].map(k => points.reduce((m, p) => Math.max(m, p[k]), -Infinity));
  const side = 1.04 * Math.max(high[0] - low[0], high[1] - low[1]);
  const [x, y] = [0, 1].map(k => (low[k] + high[k]) / 2);
  view = {side};
  set(field, 'viewBox', `${x - side / 2} ${-y - side / 2} ${side} ${side}`);
}

function build() {
  game = data.episodes[+$('select.episode').value];
  frame();
  field.replaceChildren();
  const size = data.size;
  add(field, 'rect', {class: 'ground', x: 0, y: -size, width: size, height: size});
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500].find(s => size / s <= 6) || size / 5;
  for (let x = step; x < size - 1e-6; x += step) {
    add(field, 'line', {class: 'grid', x1: x, x2: x, y1: 0, y2: -size});
    add(field, 'line', {class: 'grid', x1: 0, x2: size, y1: -x, y2: -x});
  }
  const outside = game.position.flat().some(p => Math.min(...p) < 0 || Math.max(...p) > size);
  $('.field-note').textContent = `Field: ${size} \\u00d7 ${size} m, a line every ${step} m` +
    (outside ? '; it has no walls, and rovers left it. ' : '. ') +
    `Rings: ${data.activation_distance} m around a POI; a POI is observed once ${n} ` +
    `rover${n > 1 ? 's are' : ' is'} inside together.`;
  parts = {pois: game.poi.map(ring)};
  parts.trails = game.heading[0].map((_, i) =>
    add(field, 'polyline', {class: 'trail', style: `stroke: var(--c${i % 7})`}));
  parts.labels = game.poi.map(([x, y]) => add(field, 'text', {x}));
  parts.rovers = game.heading[0].map((_, i) => triangle(i));
  slider.max = game.position.length - 1;
  slider.value = time = 0;
  drawn = {};
  play(false);
}

function ring([x, y]) {
  const r = data.activation_distance, gap = n > 1 ? Math.min(0.12, 1 / n) : 0;
  const reach = add(field, 'circle', {class: 'reach', cx: x, cy: -y, r});
  const arcs = Array.from({length: n}, (_, k) => {
    const from = TURN / 4 - TURN * k / n - gap / 2, to = TURN / 4 - TURN * (k + 1) / n + gap / 2;
    const middle = (from + to) / 2;
    const d = `M${at(r, from)}A${r} ${r} 0 0 1 ${at(r, middle)}A${r} ${r} 0 0 1 ${at(r, to)}`;
    return add(field, 'path', {d, class: 'arc', transform: `translate(${x} ${-y})`});
  });
  return {reach, arcs, dot: add(field, 'circle', {class: 'dot', cx: x, cy: -y})};
}

function triangle(i) {
  const group = add(field, 'g', {class: 'rover'});
  add(group, 'title', {}).textContent = `Rover ${i}`;
  add(group, 'circle', {class: 'hit', r: 16});
  add(group, 'circle', {class: 'halo', r: 14});
  const shape = {class: 'body', d: 'M11 0L-7 6.5L-4 0L-7 -6.5Z', style: `fill: var(--c${i % 7})`};
  const body = add(group, 'path', shape);
  if (game.heading[0].length <= 20) add(group, 'text', {y: -13}).textContent = i;
  group.addEventListener('click', () => choose(i));
  return {group, body};
}

/* A rover turns, then drives straight: between two steps it is on its way. */
function pose(i) {
  const t = Math.floor(time), part = time - t;
  const [x, y] = game.position[t][i], heading = game.heading[t][i];
  if (!part) return [x, y, heading];
  const [x2, y2] = game.position[t + 1][i], turn = game.heading[t + 1][i] - heading;
  const shortest = turn - TURN * Math.round(turn / TURN);
  return [x + part * (x2 - x), y + part * (y2 - y), heading + shortest * Math.min(1, 3 * part)];
}

function draw() {
  const t = Math.floor(time), pixel = view.side / (field.clientWidth || 600);
  game.heading[0].forEach((_, i) => {
    const [x, y, heading] = pose(i), {group, body} = parts.rovers[i];
    set(group, 'transform', `translate(${x} ${-y}) scale(${pixel})`);
    set(group, 'class', i === rover ? 'rover chosen' : 'rover');
    set(body, 'transform', `rotate(${-heading * 360 / TURN})`);
    const path = game.position.slice(0, t + 1).map(p => `${p[i][0]},${-p[i][1]}`);
    set(parts.trails[i], 'points', [...path, `${x},${-y}`].join(' '));
    set(parts.trails[i], 'class', i === rover ? 'trail chosen' : 'trail');
  });
  if (drawn.t === t && drawn.rover === rover && drawn.pixel === pixel) return;
  drawn = {t, rover, pixel};
  game.poi.forEach((_, j) => drawPoi(j, t, pixel));
  drawSensors(t);
  tell(t);
  drawRunning(t);
}

function drawPoi(j, t, pixel) {
  const {reach, arcs, dot} = parts.pois[j], label = parts.labels[j];
  const seen = game.observed[t][j] ? ' seen' : '', inside = game.inside[t][j];
  set(reach, 'class', 'reach' + seen);
  arcs.forEach((arc, k) => set(arc, 'class', 'arc' + seen + (k < inside ? ' lit' : '')));
  set(dot, 'class', 'dot' + seen);
  set(dot, 'r', 5 * pixel);
  const since = game.observed.findIndex(row => row[j]);
  /* Among many POIs, labels of those where somebody is. */
  if (game.poi.length > 20 && (seen || !inside)) label.textContent = '';
  else label.textContent = seen ? `\\u2713 step ${since}` : `${inside} of ${n}`;
  set(label, 'class', seen.trim());
  set(label, 'y', -game.poi[j][1] + 20 * pixel);
  label.style.fontSize = `${12 * pixel}px`;
  label.style.strokeWidth = `${3 * pixel}px`;
}

function drawSensors(t) {
  const heading = game.heading[t][rover], coded = data.observation === 'as-coded', w = TURN / 36;
  sensors.replaceChildren();
  [[59, 97, 'track'], [18, 57, 'track']].forEach(([inner, outer]) => {
    add(sensors, 'circle', {class: 'track', r: outer});
    add(sensors, 'circle', {class: 'hole', r: inner});
  });
  let met = [0, 0];
  game.sensors[t][rover].forEach((values, channel) => values.forEach((value, b) => {
    if (value <= 0) return;
    met[channel] += 1;
    const [inner, outer] = channel ? [59, 97] : [18, 57];
    /* As coded a value is 1/d², otherwise 1/(1 + d). */
    const strength = coded ? Math.sqrt(value) / (1 + Math.sqrt(value)) : value;
    const r = inner + Math.max(2, strength * (outer - inner));
    const from = coded ? TURN / 4 - (b + 1) * w : heading + b * w, to = from + w;
    const d = `M${at(inner, from)}L${at(r, from)}A${r} ${r} 0 0 0 ${at(r, to)}` +
      `L${at(inner, to)}A${inner} ${inner} 0 0 1 ${at(inner, from)}`;
    const bar = add(sensors, 'path', {d, class: channel ? 'pois' : 'others'});
    add(bar, 'title', {}).textContent = `${channel ? 'POI' : 'rover'}, bracket ${b}: ${value}`;
  }));
  add(sensors, 'path', {d: 'M11 0L-7 6.5L-4 0L-7 -6.5Z', style: `fill: var(--c${rover % 7})`,
    transform: `rotate(${-heading * 360 / TURN})`});
  set(sensors, 'aria-label', `Sensors of rover ${rover} at step ${t}: other rovers in ` +
    `${met[0]} directions, POIs in ${met[1]}`);
}

function tell(t) {
  const steps = game.position.length - 1, seen = game.observed[t].filter(Boolean).length;
  $('.step').textContent = `step ${t} of ${steps}`;
  set($('.step'), 'aria-live', playing ? 'off' : 'polite');
  set(slider, 'aria-valuetext', `step ${t} of ${steps}, ${seen} POIs observed`);
  set(field, 'aria-label', `The field from above at step ${t}: ` + game.poi.map((p, j) =>
    `POI ${j} ` + (game.observed[t][j] ? 'observed' : `${game.inside[t][j]} of ${n} inside`))
    .join(', '));
  $('.who').textContent = `What rover ${rover} senses`;
  $('select.rover').value = rover;
  const rows = Object.entries(game.rewards).map(([name, all]) => {
    const own = Array.isArray(all[0]), values = own ? all.map(row => row[rover]) : all;
    const sum = values.slice(0, t + 1).reduce((a, b) => a + b, 0);
    return [`${name}${own ? ` (rover ${rover})` : ' (team)'}`, number(values[t]), number(sum)];
  });
  $('tbody').replaceChildren(...rows.map(cells => {
    const row = document.createElement('tr');
    cells.forEach((text, k) => {
      const cell = row.appendChild(document.createElement('td'));
      cell.textContent = text;
      if (k) cell.className = 'number';
    });
    return row;
  }));
  $('.total').textContent = `${seen} of ${game.poi.length} POIs observed: the global reward ` +
    `${t === steps ? 'is' : 'would be'} ${number(game.share[t])}` +
    (t === steps ? '.' : ' if the episode ended here; it is paid at the end.');
}

/* What the team, and the chosen rover, earned over time; up to now in colour. A step pays from
   the one before to itself, so that a curve has stairs and the start has none. */
function drawRunning(t) {
  const own = Object.entries(game.rewards).filter(([_, all]) => Array.isArray(all[0]));
  const curves = [['global reward, if it ended there', game.share, 'var(--seen)', 1],
    ...own.map(([name, all]) => [`${name} of rover ${rover} in each step`,
      all.map(row => row[rover]), `var(--c${rover % 7})`, 0])];
  $('.running').replaceChildren(...curves.map(([title, values, color, most]) => {
    const paid = values.slice(1), low = Math.min(0, ...paid), high = Math.max(most, ...paid);
    const wide = paid.length, span = high - low || 1;
    const points = paid.map((v, k) => {
      const y = 38 - 36 * (v - low) / span;
      return `${100 * k / wide},${y} ${100 * (k + 1) / wide},${y}`;
    });
    const figure = document.createElement('figure');
    const text = `${title}: ${number(low)} to ${number(high)}`;
    const svg = add(figure, 'svg', {viewBox: '-1 0 102 40', preserveAspectRatio: 'none',
      role: 'img', 'aria-label': `${text}, now ${number(values[t])}`});
    add(svg, 'polyline', {class: 'later', points: points.join(' ')});
    add(svg, 'polyline', {class: 'sofar', points: points.slice(0, t).join(' '),
      style: `stroke: ${color}`});
    add(svg, 'line', {class: 'now', x1: 100 * t / wide, x2: 100 * t / wide, y1: 0, y2: 40});
    const caption = document.createElement('figcaption');
    caption.textContent = text;
    figure.prepend(caption);
    return figure;
  }));
}

function go(t) {
  time = Math.max(0, Math.min(+slider.max, t));
  slider.value = Math.floor(time);
  draw();
}
function choose(i) {
  const all = game.heading[0].length;
  rover = (i + all) % all;
  draw();
}
function play(on) {
  if (on && time >= +slider.max) go(0);
  playing = on;
  button.textContent = on ? '\\u275a\\u275a' : '\\u25b6';
  set(button, 'aria-label', on ? 'Pause' : 'Play');
  if (!on) time = Math.floor(time);
  drawn = {};
  draw();
  if (on) { last = performance.now(); clock = time; requestAnimationFrame(tick); }
}
let clock = 0;
function tick(now) {
  if (!playing) return;
  clock = Math.min(+slider.max, clock + Math.max(0, now - last) / 1000 * +$('select.speed').value);
  last = now;
  go(calm.matches ? Math.floor(clock) : clock);
  if (clock >= +slider.max) play(false);
  else requestAnimationFrame(tick);
}

button.addEventListener('click', () => play(!playing));
slider.addEventListener('input', () => { if (playing) play(false); go(+slider.value); });
$('select.episode').addEventListener('change', build);
$('select.rover').addEventListener('change', event => choose(+event.target.value));
const KEYS = {
  ' ': () => play(!playing),
  ArrowLeft: () => { play(false); go(time - 1); },
  ArrowRight: () => { play(false); go(time + 1); },
  ArrowUp: () => choose(rover - 1),
  ArrowDown: () => choose(rover + 1),
  Home: () => { play(false); go(0); },
  End: () => { play(false); go(Infinity); },
};
document.addEventListener('keydown', event => {
  const here = event.target;
  const mine = root.contains(here) || here === document.body &&
    root === document.querySelector('.replay');
  if (!mine || !(event.key in KEYS) || event.ctrlKey || event.altKey || event.metaKey) return;
  /* What has the focus keeps the keys it knows. */
  if (here.matches('select') || here === button && event.key === ' ') return;
  event.preventDefault();
  KEYS[event.key]();
});
new ResizeObserver(draw).observe(field);
build();
})();
"""
