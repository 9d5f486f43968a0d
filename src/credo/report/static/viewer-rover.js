/* Rovers on their field, and what the chosen one senses. */
credo.draw(view => {
const {field, panel, task, add, html, set, number, color} = view;
const TURN = 2 * Math.PI, reach = task.activation_distance;
const at = (radius, angle) => `${radius * Math.cos(angle)} ${-radius * Math.sin(angle)}`;
const who = html(panel, 'h2', {class: 'who'});
const sensors = add(panel, 'svg', {class: 'sensors', viewBox: '-100 -100 200 200', role: 'img'});
html(panel, 'p', {class: 'note'}, 'In 36 directions of the field; the longer a bar, the closer the target.');
const total = html(panel, 'p', {class: 'note total'}), size = html(panel, 'p', {class: 'note'});
let game, side, parts, drawn;

/* A view that holds the field and whatever the rovers reached outside it; y points up. */
function frame() {
  const points = [[0, 0], [task.size, task.size], ...game.position.flat()];
  for (const [x, y] of game.poi) points.push([x - reach, y - reach], [x + reach, y + reach]);
  const low = [0, 1].map(k => points.reduce((m, p) => Math.min(m, p[k]), Infinity));
  const high = [0, 1].map(k => points.reduce((m, p) => Math.max(m, p[k]), -Infinity));
  side = 1.04 * Math.max(high[0] - low[0], high[1] - low[1]);
  const [x, y] = [0, 1].map(k => (low[k] + high[k]) / 2);
  set(field, 'viewBox', `${x - side / 2} ${-y - side / 2} ${side} ${side}`);
}

function build(episode) {
  game = episode;
  frame();
  add(field, 'rect', {class: 'ground', x: 0, y: -task.size, width: task.size, height: task.size});
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500].find(s => task.size / s <= 6) || task.size / 5;
  for (let x = step; x < task.size - 1e-6; x += step) {
    add(field, 'line', {class: 'grid', x1: x, x2: x, y1: 0, y2: -task.size});
    add(field, 'line', {class: 'grid', x1: 0, x2: task.size, y1: -x, y2: -x});
  }
  const outside = game.position.flat().some(p => Math.min(...p) < 0 || Math.max(...p) > task.size);
  size.textContent = `Field: ${task.size} \u00d7 ${task.size} m, a line every ${step} m` +
    (outside ? '; it has no walls, and rovers left it.' : '.');
  parts = {pois: game.poi.map(ring)};
  parts.trails = game.heading[0].map((_, i) =>
    add(field, 'polyline', {class: 'trail', style: `stroke: ${color(i)}`}));
  parts.labels = game.poi.map(([x]) => add(field, 'text', {x}));
  parts.rovers = game.heading[0].map((_, i) => triangle(i));
  drawn = {};
}

function ring([x, y], j) {
  const r = reach, n = task.needed[j], gap = n > 1 ? Math.min(0.12, 1 / n) : 0;
  const disc = add(field, 'circle', {class: 'reach', cx: x, cy: -y, r});
  const arcs = Array.from({length: n}, (_, k) => {
    const from = TURN / 4 - TURN * k / n - gap / 2, to = TURN / 4 - TURN * (k + 1) / n + gap / 2;
    const middle = (from + to) / 2;
    const d = `M${at(r, from)}A${r} ${r} 0 0 1 ${at(r, middle)}A${r} ${r} 0 0 1 ${at(r, to)}`;
    return add(field, 'path', {d, class: 'arc', transform: `translate(${x} ${-y})`});
  });
  return {disc, arcs, dot: add(field, 'path', {class: 'dot', d: 'M0 -6L6 0L0 6L-6 0Z'})};
}

function triangle(i) {
  const group = add(field, 'g', {class: 'rover'});
  add(group, 'title', {}, `Rover ${i}`);
  add(group, 'circle', {class: 'hit', r: 16});
  add(group, 'circle', {class: 'halo', r: 14});
  const body = add(group, 'path', {class: 'body', d: 'M11 0L-7 6.5L-4 0L-7 -6.5Z', style: `fill: ${color(i)}`});
  if (game.heading[0].length <= 20) add(group, 'text', {y: -13}, i);
  group.addEventListener('click', () => view.choose(i));
  return {group, body};
}

/* A rover turns, then drives straight: between two steps it is on its way. */
function pose(i, time) {
  const t = Math.floor(time), part = time - t;
  const [x, y] = game.position[t][i], heading = game.heading[t][i];
  if (!part) return [x, y, heading];
  const [x2, y2] = game.position[t + 1][i], turn = game.heading[t + 1][i] - heading;
  const shortest = turn - TURN * Math.round(turn / TURN);
  return [x + part * (x2 - x), y + part * (y2 - y), heading + shortest * Math.min(1, 3 * part)];
}

function draw(time) {
  const t = Math.floor(time), rover = view.agent(), pixel = side / (field.clientWidth || 600);
  game.heading[0].forEach((_, i) => {
    const [x, y, heading] = pose(i, time), {group, body} = parts.rovers[i];
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
  drawSensors(t, rover);
  const steps = game.steps, seen = game.observed[t].filter(Boolean).length;
  total.textContent = `${seen} of ${game.poi.length} POIs observed: the global reward ` +
    `${t === steps ? 'is' : 'would be'} ${number(game.share[t])}` +
    (t === steps ? '.' : ' if the episode ended here; it is paid at the end.');
  set(field, 'aria-label', `The field from above at step ${t}: ` + game.poi.map((p, j) =>
    `POI ${j} ` + (game.observed[t][j] ? 'observed' : `${game.inside[t][j]} of ${task.needed[j]} inside`)).join(', '));
}

function drawPoi(j, t, pixel) {
  const {disc, arcs, dot} = parts.pois[j], label = parts.labels[j], [x, y] = game.poi[j];
  const seen = game.observed[t][j] ? ' seen' : '', inside = game.inside[t][j];
  set(disc, 'class', 'reach' + seen);
  arcs.forEach((arc, k) => set(arc, 'class', 'arc' + seen + (k < inside ? ' lit' : '')));
  set(dot, 'class', 'dot' + seen);
  set(dot, 'transform', `translate(${x} ${-y}) scale(${pixel})`);
  const since = game.observed.findIndex(row => row[j]);
  /* Among many POIs, labels of those where a rover is. */
  if (game.poi.length > 20 && (seen || !inside)) label.textContent = '';
  else label.textContent = seen ? `\u2713 step ${since}` : `${inside} of ${task.needed[j]}`;
  set(label, 'class', seen.trim());
  set(label, 'y', -y + 20 * pixel);
  label.style.fontSize = `${12 * pixel}px`;
  label.style.strokeWidth = `${3 * pixel}px`;
}

function drawSensors(t, rover) {
  const heading = game.heading[t][rover], coded = task.observation === 'as-coded', w = TURN / 36;
  who.textContent = `What rover ${rover} senses`;
  sensors.replaceChildren();
  [[59, 97], [18, 57]].forEach(([inner, outer]) => {
    add(sensors, 'circle', {class: 'track', r: outer});
    add(sensors, 'circle', {class: 'hole', r: inner});
  });
  const met = [0, 0];
  game.sensors[t][rover].forEach((values, channel) => values.forEach((value, b) => {
    if (value <= 0) return;
    met[channel] += 1;
    const [inner, outer] = channel ? [59, 97] : [18, 57];
    /* As coded a value is 1/d², otherwise 1/(1 + d). */
    const strength = coded ? Math.sqrt(value) / (1 + Math.sqrt(value)) : value;
    const r = inner + Math.max(2, Math.min(1, strength) * (outer - inner));
    const from = coded ? TURN / 4 - (b + 1) * w : heading + b * w, to = from + w;
    const d = `M${at(inner, from)}L${at(r, from)}A${r} ${r} 0 0 0 ${at(r, to)}` +
      `L${at(inner, to)}A${inner} ${inner} 0 0 1 ${at(inner, from)}`;
    const bar = add(sensors, 'path', {d, class: channel ? 'pois' : 'others'});
    add(bar, 'title', {}, `${channel ? 'POI' : 'rover'}, bracket ${b}: ${value}`);
  }));
  add(sensors, 'path', {d: 'M11 0L-7 6.5L-4 0L-7 -6.5Z', style: `fill: ${color(rover)}`,
    transform: `rotate(${-heading * 360 / TURN})`});
  set(sensors, 'aria-label', `Sensors of rover ${rover} at step ${t}: other rovers in ` +
    `${met[0]} directions, POIs in ${met[1]}`);
}

return {build, draw};
});
