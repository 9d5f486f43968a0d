/* Servers below, devices above: who serves whom, and what is left. */
credo.draw(view => {
const {field, panel, task, add, html, set, number, color} = view;
const devices = task.devices, servers = task.servers, WIDE = 240;
const rows = Math.ceil(devices / 10), perRow = Math.ceil(devices / rows), HIGH = 46 * rows + 84;
const now = html(panel, 'h2'), told = html(panel, 'p', {class: 'note'});
const device = j => [WIDE * (j % perRow + .5) / Math.min(perRow, devices), 18 + 46 * Math.floor(j / perRow)];
const server = i => [WIDE * (i + .5) / servers, HIGH - 26];
let game, parts;

function build(episode) {
  game = episode;
  set(field, 'viewBox', `0 0 ${WIDE} ${HIGH}`);
  parts = {lines: Array.from({length: servers}, (_, i) => add(field, 'line', {class: 'serving', style: `stroke: ${color(i)}`}))};
  parts.devices = Array.from({length: devices}, (_, j) => box(j));
  parts.servers = Array.from({length: servers}, (_, i) => machine(i));
}

function box(j) {
  const [x, y] = device(j), good = game.genuine[j], group = add(field, 'g', {transform: `translate(${x} ${y})`});
  add(group, 'title', {}, `Device ${j}, ${good ? 'genuine' : 'nefarious'}`);
  add(group, 'path', {class: good ? 'device good' : 'device bad',
    d: good ? 'M-8 -8H8V8H-8Z' : 'M0 -10.5L10.5 0L0 10.5L-10.5 0Z'});
  add(group, 'text', {y: 19, class: 'name'}, j);
  return {left: add(group, 'text', {y: 3.4, class: 'left'}), group};
}

function machine(i) {
  const [x, y] = server(i), group = add(field, 'g', {transform: `translate(${x} ${y})`, class: 'server'});
  add(group, 'title', {}, `Server ${i}`);
  add(group, 'circle', {class: 'halo', r: 10});
  const body = add(group, 'circle', {r: 7.5, style: `stroke: ${color(i)}`});
  add(group, 'text', {y: 19, class: 'name'}, i);
  group.addEventListener('click', () => view.choose(i));
  return {group, body, text: add(group, 'text', {y: 3, class: 'worth'})};
}

function draw(time) {
  const t = Math.floor(time), next = Math.min(t, game.steps - 1), last = t === game.steps;
  parts.devices.forEach(({left, group}, j) => {
    left.textContent = game.pending[t][j];
    set(group, 'class', game.pending[t][j] ? '' : 'empty');
  });
  parts.servers.forEach(({group, body, text}, i) => {
    const status = game.status[t][i], worth = t && game.choice[t - 1][i] >= 0 ? game.worth[t - 1][i] : null;
    set(group, 'class', 'server ' + ['away', 'busy', 'acts'][status + 1] + (i === view.agent() ? ' chosen' : ''));
    body.style.fill = status === 1 ? color(i) : 'var(--page)';
    text.textContent = worth === null ? '' : worth > 0 ? '+1' : worth < 0 ? '\u22121' : '0';
    set(text, 'class', 'worth ' + (worth > 0 ? 'good' : worth < 0 ? 'bad' : ''));
    set(text, 'y', -12);
    const choice = last ? -1 : game.choice[next][i], line = parts.lines[i];
    line.style.display = choice < 0 ? 'none' : '';
    if (choice < 0) return;
    const [x1, y1] = server(i), [x2, y2] = device(choice);
    for (const [name, value] of Object.entries({x1, y1: y1 - 7, x2, y2: y2 + 9})) set(line, name, value);
  });
  const served = game.worth.slice(0, t).flat();
  now.textContent = last ? 'The end' : `Step ${t}: ${game.status[t].filter(s => s === 1).length} of ${servers} servers act`;
  told.textContent = `Served so far: ${served.filter(w => w > 0).length} genuine and ` +
    `${served.filter(w => w < 0).length} nefarious requests.`;
  set(field, 'aria-label', `Fleet at step ${t}: ${game.pending[t].reduce((a, b) => a + b, 0)} requests pending`);
}

return {build, draw};
});
