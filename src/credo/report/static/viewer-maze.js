/* Robots in a tree of corridors, and every trial as a column. */
credo.draw(view => {
const {field, panel, task, add, html, set, color, star} = view;
const depth = task.depth, n = 2 ** depth, WIDE = 200, HIGH = 50 + 34 * depth;
const now = html(panel, 'h2'), told = html(panel, 'p', {class: 'note'});
html(panel, 'h2', {}, 'Trials');
const cell = Math.min(16, 300 / (3 * n));
const trials = add(panel, 'svg', {class: 'trials', role: 'img',
  viewBox: `-14 -2 ${3 * n * cell + 16} ${n * cell + 26}`});
const trialsNote = html(panel, 'p', {class: 'note'},
  'A column for each trial, a row for each endpoint; the reward moves at the lines.');
const turns = end => Array.from({length: depth}, (_, k) => end >> (depth - 1 - k) & 1 ? 'R' : 'L').join('');
/* Where a junction or, at level `depth`, an endpoint lies; `bits`: the turns on the way to it. */
const place = (level, bits) => [WIDE * (bits + .5) / 2 ** level, HIGH - 30 - 34 * level];
let game, parts;

/* After `part` of the corridor behind a turn: first aside, then ahead. */
function along(level, bits, part) {
  const [x, y] = place(level, bits);
  if (level === 0) return [x, y + 18 * (1 - part)];
  const [x0, y0] = place(level - 1, bits >> 1), aside = Math.abs(x - x0), way = aside + y0 - y;
  const gone = part * way;
  return gone < aside ? [x0 + Math.sign(x - x0) * gone, y0] : [x, y0 - (gone - aside)];
}

function where(t, bits) {
  const {level, part} = {level: game.level[t], part: game.part[t]};
  return level < 0 ? along(0, 0, 0) : along(level, bits, part);
}

function build(episode) {
  game = episode;
  set(field, 'viewBox', `0 0 ${WIDE} ${HIGH}`);
  const paths = [`M${along(0, 0, 0)}L${place(0, 0)}`];
  for (let level = 1; level <= depth; level++)
    for (let bits = 0; bits < 2 ** level; bits++) {
      const [x, y] = place(level, bits), [x0, y0] = place(level - 1, bits >> 1);
      paths.push(`M${x0} ${y0}H${x}V${y}`);
    }
  const d = paths.join(''), wide = Math.min(12, 110 / n);
  add(field, 'path', {class: 'corridor edge', d, style: `stroke-width: ${wide + 1.2}`});
  add(field, 'path', {class: 'corridor', d, style: `stroke-width: ${wide}`});
  if (n <= 16)
    for (let end = 0; end < n; end++)
      add(field, 'text', {x: place(depth, end)[0], y: 7, class: 'end'}, turns(end));
  parts = {goal: add(field, 'path', {class: 'goal'}), r: 0};
  const r = Math.min(3.4, wide / (2.3 * (game.turns[0].length + (game.partner ? 1 : 0))));
  parts.r = r;
  parts.robots = game.turns[0].map((_, i) => robot(color(i), r, i));
  if (game.partner) parts.robots.push(robot('var(--muted)', r, null));
  columns();
}

function robot(fill, r, i) {
  const group = add(field, 'g', {class: i === null ? 'robot static' : 'robot'});
  add(group, 'title', {}, i === null ? 'Static robot' : `Robot ${i}`);
  add(group, 'circle', {class: 'halo', r: r + .9});
  if (i === null) add(group, 'rect', {x: -r, y: -r, width: 2 * r, height: 2 * r, style: `fill: ${fill}`});
  else add(group, 'circle', {r, style: `fill: ${fill}`});
  if (i !== null) group.addEventListener('click', () => view.choose(i));
  return group;
}

function columns() {
  trials.replaceChildren();
  const y = end => cell * (n - 1 - end), all = 3 * n;
  for (let end = 0; end < n; end++)
    if (n <= 8) add(trials, 'text', {x: -3, y: y(end) + .7 * cell, class: 'row'}, turns(end));
  parts.columns = Array.from({length: all}, (_, trial) => {
    const group = add(trials, 'g', {transform: `translate(${trial * cell} 0)`});
    add(group, 'rect', {class: 'column', width: cell, height: n * cell});
    const goal = game.goal[trial];
    add(group, 'rect', {class: 'goal', y: y(goal), width: cell, height: cell});
    const everybody = [...game.endpoint[trial], ...(game.static ? [game.static[trial]] : [])];
    everybody.forEach((end, i) => {
      const part = cell * (i + .5) / everybody.length, r = Math.min(.3, .42 / everybody.length) * cell;
      const still = game.static && i === everybody.length - 1;
      if (still) add(group, 'rect', {x: part - r, y: y(end) + cell / 2 - r, width: 2 * r, height: 2 * r, style: 'fill: var(--muted)'});
      else add(group, 'circle', {cx: part, cy: y(end) + cell / 2, r, style: `fill: ${color(i)}`});
    });
    const seen = game.observed[trial], x = cell / 2, low = n * cell + 7, s = Math.min(3.2, cell / 3);
    add(group, 'path', {class: seen ? 'yes' : 'no', d: seen ? `M${x - s} ${low}l${.7 * s} ${s}l${1.3 * s} ${-2 * s}`
      : `M${x - s} ${low - s}l${2 * s} ${2 * s}m0 ${-2 * s}l${-2 * s} ${2 * s}`});
    return group;
  });
  [1, 2].forEach(k => add(trials, 'line', {class: 'break', x1: k * n * cell, x2: k * n * cell, y1: -2, y2: n * cell + 12}));
  [1, n, 2 * n, 3 * n].forEach(k => add(trials, 'text', {x: (k - .5) * cell, y: n * cell + 21, class: 'axis'}, k));
  parts.now = add(trials, 'rect', {class: 'now', width: cell, height: n * cell});
}

function draw(time) {
  const t = Math.floor(time), part = time - t, trial = game.trial[t];
  const next = Math.min(t + 1, game.steps), going = part && game.trial[next] === trial;
  parts.robots.forEach((group, i) => {
    const bits = u => i < game.turns[u].length ? game.turns[u][i]
      : game.partner[u] >> Math.max(0, depth - Math.max(0, game.level[u]));
    let [x, y] = where(t, bits(t));
    if (going) {
      const [x2, y2] = where(next, bits(next));
      [x, y] = [x + part * (x2 - x), y + part * (y2 - y)];
    }
    /* Side by side where they are together. */
    const aside = 2.15 * parts.r * (i - (parts.robots.length - 1) / 2);
    set(group, 'transform', `translate(${x + aside} ${y})`);
    group.classList.toggle('chosen', i === view.agent() && i < game.turns[0].length);
  });
  const goal = game.goal[trial], [x, y] = place(depth, goal), over = game.level[t] === depth;
  set(parts.goal, 'd', star(x, y - 2, Math.min(6, 60 / n)));
  set(parts.goal, 'class', over && game.observed[trial] ? 'goal found' : 'goal');
  parts.columns.forEach((group, k) => set(group, 'class', k < trial || k === trial && over ? '' : 'later'));
  set(parts.now, 'x', trial * cell);
  now.textContent = `Trial ${trial + 1} of ${3 * n}`;
  const words = over ? [game.company[trial][view.agent()] ? 'company' : '', game.reward[trial][view.agent()] ? 'the reward' : '']
    .filter(Boolean) : [];
  told.textContent = over
    ? `The reward was ${game.observed[trial] ? '' : 'not '}observed. Robot ${view.agent()} is told of ${words.join(' and ') || 'nothing'}.`
    : `The reward is at ${turns(goal)}.`;
  set(field, 'aria-label', `The maze in trial ${trial + 1}; the reward is at ${turns(goal)}`);
  set(trials, 'aria-label', `Trials so far: the reward was observed in ` +
    `${game.observed.slice(0, trial + (over ? 1 : 0)).filter(Boolean).length} of ${trial + (over ? 1 : 0)}`);
}

return {build, draw};
});
