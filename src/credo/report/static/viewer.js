/* Plays episodes in the browser: time, agents, rewards and memory of any task. What a world looks
   like is drawn by a script that calls credo.draw(make). `make(view)` returns {build(game), draw(time)}:
   build sets the scene of an episode, draw shows a time, whose whole numbers are moments. */
const credo = (() => {
const NS = 'http://www.w3.org/2000/svg';
const calm = matchMedia('(prefers-reduced-motion: reduce)');
const dark = matchMedia('(prefers-color-scheme: dark)');

function add(parent, tag, attributes = {}, text) {
  const node = document.createElementNS(NS, tag);
  for (const name in attributes) node.setAttribute(name, attributes[name]);
  if (text !== undefined) node.textContent = text;
  return parent.appendChild(node);
}
function html(parent, tag, attributes = {}, text) {
  const node = document.createElement(tag);
  for (const name in attributes) node.setAttribute(name, attributes[name]);
  if (text !== undefined) node.textContent = text;
  return parent.appendChild(node);
}
const set = (node, name, value) => node.setAttribute(name, value);
const number = x => (Math.abs(x) >= 100 ? x.toFixed(1) : x.toFixed(2)).replace('-', '\u2212')
  .replace(/^\u2212(0\.0+)$/, '$1');
const color = i => `var(--c${i % 7})`;

/* The marks of a legend, on a box of 24 by 16. */
const SHAPES = {
  dot: c => ['circle', {cx: 12, cy: 8, r: 5, fill: c}],
  ring: c => ['circle', {cx: 12, cy: 8, r: 5, fill: 'none', stroke: c, 'stroke-width': 2}],
  box: c => ['rect', {x: 7, y: 3, width: 10, height: 10, fill: 'none', stroke: c, 'stroke-width': 2}],
  square: c => ['rect', {x: 7, y: 3, width: 10, height: 10, fill: c}],
  line: c => ['path', {d: 'M2 8H22', stroke: c, 'stroke-width': 2.5}],
  dashed: c => ['path', {d: 'M2 8H22', stroke: c, 'stroke-width': 2, 'stroke-dasharray': '4 3'}],
  star: c => ['path', {d: star(12, 8, 7), fill: c}],
  cross: c => ['path', {d: 'M8 4L16 12M16 4L8 12', stroke: c, 'stroke-width': 2.5}],
  tick: c => ['path', {d: 'M7 8L10.5 12L17 4', stroke: c, 'stroke-width': 2, fill: 'none'}],
  plus: c => ['path', {d: 'M7 8H17M12 3V13', stroke: c, 'stroke-width': 2.5}],
  minus: c => ['path', {d: 'M7 8H17', stroke: c, 'stroke-width': 2.5}],
  rhombus: c => ['path', {d: 'M12 2L18 8L12 14L6 8Z', fill: 'none', stroke: c, 'stroke-width': 2}],
  diamond: c => ['path', {d: 'M12 2L18 8L12 14L6 8Z', fill: c}],
  arrow: c => ['path', {d: 'M21 8L5 14L8 8L5 2Z', fill: c}],
};
function star(x, y, r) {
  const points = Array.from({length: 10}, (_, k) => {
    const angle = Math.PI * (k / 5 - .5), length = k % 2 ? .42 * r : r;
    return `${x + length * Math.cos(angle)} ${y + length * Math.sin(angle)}`;
  });
  return `M${points.join('L')}Z`;
}

function start(root, make) {
  const data = JSON.parse(root.querySelector('script[type="application/json"]').textContent);
  const $ = name => root.querySelector(name);
  const field = $('.field'), slider = $('.time'), button = $('.play');
  let game, time = 0, agent = 0, playing = false, last = 0, clock = 0, shown = {}, heat = null;
  const view = {
    root, field, panel: $('.panel'), data, task: data.task, add, html, set, number, color, star,
    choose, agent: () => agent, $,
  };
  const drawing = make(view);

  function build() {
    game = data.episodes[+$('select.episode').value];
    slider.max = game.steps;
    slider.value = time = 0;
    field.replaceChildren();
    drawing.build(game);
    memory();
    play(false);
  }

  function draw() {
    drawing.draw(time);
    const t = Math.floor(time);
    if (shown.t === t && shown.agent === agent && shown.wide === root.clientWidth) return;
    shown = {t, agent, wide: root.clientWidth};
    const text = `step ${t} of ${game.steps}`;
    const over = t === game.steps ? `, ${game.ended}` : '';
    $('.step').textContent = text + over;
    set($('.step'), 'aria-live', playing ? 'off' : 'polite');
    set(slider, 'aria-valuetext', text + over);
    if ($('select.agent')) $('select.agent').value = agent;
    rewards(t);
    remember(t);
  }

  /* Rewards by name: paid by the step that led here, and so far; and over time. A step pays from
     the moment before to its own, so that a curve has stairs. */
  function rewards(t) {
    const rows = Object.entries(game.rewards).map(([name, all]) => {
      const own = Array.isArray(all[0]), paid = own ? all.map(row => row[agent]) : all;
      const whose = own ? ` (${data.agent} ${agent})` : data.agents ? ' (team)' : '';
      const sum = paid.slice(0, t).reduce((a, b) => a + b, 0);
      return {text: name + whose, now: t ? paid[t - 1] : 0, sum, paid, color: own ? color(agent) : 'var(--ink)'};
    });
    $('.rewards tbody').replaceChildren();
    rows.forEach(row => {
      const line = html($('.rewards tbody'), 'tr');
      html(line, 'td', {}, row.text);
      html(line, 'td', {class: 'number'}, number(row.now));
      html(line, 'td', {class: 'number'}, number(row.sum));
    });
    $('.running').replaceChildren();
    rows.forEach(row => curve(row, t));
  }

  function curve({text, paid, color}, t) {
    const low = paid.reduce((m, v) => Math.min(m, v), 0);
    const high = paid.reduce((m, v) => Math.max(m, v), low === 0 ? 1e-9 : 0);
    const wide = paid.length, points = paid.map((v, k) => {
      const y = 38 - 36 * (v - low) / (high - low);
      return `${100 * k / wide},${y} ${100 * (k + 1) / wide},${y}`;
    });
    const figure = html($('.running'), 'figure');
    html(figure, 'figcaption', {}, `${text} in each step: ${number(low)} to ${number(high)}`);
    const svg = add(figure, 'svg', {viewBox: '-1 0 102 40', preserveAspectRatio: 'none',
      role: 'img', 'aria-label': `${text}, step by step`});
    add(svg, 'polyline', {class: 'later', points: points.join(' ')});
    add(svg, 'polyline', {class: 'sofar', points: points.slice(0, t).join(' '),
      style: `stroke: ${color}`});
    add(svg, 'line', {class: 'now', x1: 100 * t / wide, x2: 100 * t / wide, y1: 0, y2: 40});
  }

  /* The policy's memory as a heat map: a row for each cell, a column for each moment. */
  function memory() {
    const box = $('.memory');
    heat = null;
    box.replaceChildren();
    if (!game.memory) return;
    const own = !game.memory.shared, cells = (own ? game.memory.values[0][0] : game.memory.values[0]).length;
    const size = Math.max(3, Math.min(16, 240 / cells));
    const title = html(box, 'h2');
    const grid = html(box, 'div', {class: 'heat'});
    const canvas = html(grid, 'canvas', {role: 'img', width: game.steps + 1, height: cells});
    canvas.style.height = `${size * cells}px`;
    const later = html(grid, 'div', {class: 'later'}), values = [];
    if (size >= 12)
      for (let i = 0; i < cells; i++) {
        const style = `top: ${size * i}px; height: ${size}px; line-height: ${size}px`;
        html(grid, 'span', {class: 'cell', style}, `M${i + 1}`);
        values.push(html(grid, 'span', {class: 'value', style}));
      }
    html(box, 'p', {class: 'note'}, `A row for each of ${cells} cells, from the start to the end` +
      `${values.length ? ', and its value now' : ''}. Orange: above 0, blue: below; the largest value of ` +
      'a row has the full colour. What is faint is to come.');
    heat = {own, cells, canvas, later, values, title, drawn: null};
  }

  function remember(t) {
    if (!heat) return;
    const rows = game.memory.values.map(row => heat.own ? row[agent] : row);
    const key = `${heat.own ? agent : 'all'} ${dark.matches}`;
    if (heat.drawn !== key) paint(rows);
    heat.drawn = key;
    heat.title.textContent = heat.own && data.agents ? `Memory of ${data.agent} ${agent}` : 'Memory' +
      (data.agents ? ', shared by all' : '');
    heat.later.style.left = `calc(2rem + (100% - 5.5rem) * ${(t + 1) / (game.steps + 1)})`;
    heat.values.forEach((node, i) => node.textContent = number(rows[t][i]));
    set(heat.canvas, 'aria-label', `Memory at step ${t}: ${rows[t].map(number).join(', ')}`);
  }

  function paint(rows) {
    const most = rows[0].map((_, i) => rows.reduce((m, row) => Math.max(m, Math.abs(row[i])), 1e-9));
    const pen = heat.canvas.getContext('2d'), picture = pen.createImageData(rows.length, heat.cells);
    const zero = dark.matches ? [32, 36, 42] : [246, 247, 248];
    const ends = dark.matches ? [[94, 178, 240], [255, 150, 80]] : [[0, 94, 168], [196, 78, 0]];
    rows.forEach((row, t) => row.forEach((v, i) => {
      const end = ends[v < 0 ? 0 : 1], part = Math.min(1, Math.abs(v) / most[i]);
      const at = 4 * (i * rows.length + t);
      for (let k = 0; k < 3; k++) picture.data[at + k] = zero[k] + part * (end[k] - zero[k]);
      picture.data[at + 3] = 255;
    }));
    pen.putImageData(picture, 0, 0);
  }

  function legend() {
    data.legend.forEach(({shape, color, text}) => {
      const item = html($('.legend'), 'li'), svg = add(item, 'svg', {viewBox: '0 0 24 16', 'aria-hidden': true});
      add(svg, ...SHAPES[shape](`var(--${color})`));
      html(item, 'span', {}, text);
    });
  }

  function go(t) {
    time = Math.max(0, Math.min(+slider.max, t));
    slider.value = Math.floor(time);
    draw();
  }
  function choose(i) {
    if (!data.agents) return;
    agent = (i + data.agents) % data.agents;
    draw();
  }
  function play(on) {
    if (on && time >= +slider.max) go(0);
    playing = on;
    button.textContent = on ? '\u275a\u275a' : '\u25b6';
    set(button, 'aria-label', on ? 'Pause' : 'Play');
    if (!on) time = Math.floor(time);
    shown = {};
    draw();
    if (on) { last = performance.now(); clock = time; requestAnimationFrame(tick); }
  }
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
  if ($('select.agent')) $('select.agent').addEventListener('change', event => choose(+event.target.value));
  const KEYS = {
    ' ': () => play(!playing),
    ArrowLeft: () => { play(false); go(time - 1); },
    ArrowRight: () => { play(false); go(time + 1); },
    ArrowUp: () => choose(agent - 1),
    ArrowDown: () => choose(agent + 1),
    Home: () => { play(false); go(0); },
    End: () => { play(false); go(Infinity); },
  };
  document.addEventListener('keydown', event => {
    const here = event.target;
    const mine = root.contains(here) || here === document.body &&
      root === document.querySelector('.viewer');
    if (!mine || !(event.key in KEYS) || event.ctrlKey || event.altKey || event.metaKey) return;
    /* What has the focus keeps the keys it knows. */
    if (here.matches('select') || here === button && event.key === ' ') return;
    event.preventDefault();
    KEYS[event.key]();
  });
  dark.addEventListener('change', () => { shown = {}; draw(); });
  new ResizeObserver(() => draw()).observe(field);
  legend();
  build();
}

return {
  /* Starts the player that stands before this script. */
  draw: make => start(document.currentScript.closest('.viewer'), make),
};
})();
