/* A sequence around the present step, and all of it below. */
credo.draw(view => {
const {field, panel, task, add, html, set, number, color} = view;
/* On a phone fewer steps, larger. */
const phone = field.clientWidth < 520, WIDE = phone ? 220 : 400, AROUND = phone ? 12 : 20;
const LEFT = 4, ROW = 46, rows = task.inputs.length + 1;
const now = html(panel, 'h2'), told = html(panel, 'p', {class: 'note'});
let game, parts;

function build(episode) {
  game = episode;
  const high = ROW * rows + 70;
  set(field, 'viewBox', `0 0 ${WIDE} ${high}`);
  parts = {near: add(field, 'g'), all: add(field, 'g', {transform: `translate(0 ${ROW * rows + 16})`})};
  overview();
}

function overview() {
  const group = parts.all, step = (WIDE - 2 * LEFT) / game.steps, high = 34, x = t => LEFT + step * t;
  const y = v => high / 2 - .45 * high * Math.max(-1, Math.min(1, v));
  add(group, 'text', {x: LEFT, y: -4, class: 'name'}, 'the whole sequence');
  add(group, 'rect', {class: 'back', x: LEFT, width: WIDE - 2 * LEFT, height: high});
  game.inputs.slice(0, game.steps).forEach((row, t) => {
    if (row[0]) add(group, 'line', {class: 'signal', x1: x(t + .5), x2: x(t + .5), y1: y(0), y2: y(row[0])});
  });
  add(group, 'polyline', {class: 'answer', points: game.answer.map((v, t) => `${x(t + .5)},${y(v)}`).join(' ')});
  game.scored.forEach((asked, t) => {
    if (!asked) return;
    const right = game.right[t], s = 2.4;
    const mark = add(group, 'path', {class: right ? 'yes' : 'no', transform: `translate(${x(t + .5)} ${high + 7})`,
      d: right ? `M${-s} 0l${.7 * s} ${s}l${1.3 * s} ${-2 * s}` : `M${-s} ${-s}l${2 * s} ${2 * s}m0 ${-2 * s}l${-2 * s} ${2 * s}`});
    add(mark, 'title', {}, `step ${t}: ${right ? 'right' : 'wrong'}`);
  });
  parts.window = add(group, 'rect', {class: 'window', y: -1, height: high + 2});
  parts.line = add(group, 'line', {class: 'now', y1: 0, y2: high});
  parts.x = x;
}

function draw(time) {
  const from = time - AROUND, step = (WIDE - 2 * LEFT) / (2 * AROUND), x = t => LEFT + step * (t - from);
  const group = parts.near, t = Math.floor(time), until = Math.min(game.steps, t + AROUND + 1);
  group.replaceChildren();
  [...task.inputs, 'answer'].forEach((name, k) => {
    const top = ROW * k, y = v => top + 25 - 15 * Math.max(-1, Math.min(1, v));
    add(group, 'rect', {class: 'back', x: LEFT, y: top + 9, width: WIDE - 2 * LEFT, height: 32});
    add(group, 'line', {class: 'zero', x1: LEFT, x2: WIDE - LEFT, y1: y(0), y2: y(0)});
    add(group, 'text', {x: LEFT, y: top + 6, class: 'name'}, name);
    for (let s = Math.max(0, Math.ceil(from)); s < until; s++) {
      if (x(s + 1) < LEFT || x(s) > WIDE - LEFT - step) continue;
      if (k < task.inputs.length) bar(group, x(s), step, y, game.inputs[s][k], s, t, k);
      else answer(group, x(s), step, y, s, t);
    }
  });
  add(group, 'line', {class: 'now', x1: x(time), x2: x(time), y1: 8, y2: ROW * rows - 4});
  const near = [Math.max(0, from), Math.min(game.steps, time + AROUND)].map(parts.x);
  set(parts.window, 'x', near[0]);
  set(parts.window, 'width', near[1] - near[0]);
  set(parts.line, 'x1', parts.x(time));
  set(parts.line, 'x2', parts.x(time));
  const asked = game.scored.slice(0, t), right = asked.filter((a, s) => a && game.right[s]).length;
  const total = game.scored.filter(Boolean).length;
  now.textContent = `${right} of ${asked.filter(Boolean).length} answers right so far`;
  told.textContent = `${total} answers count. ` + (t < game.steps
    ? `Next to be read: ${task.inputs.map((name, k) => `${name} ${number(game.inputs[t][k])}`).join(', ')}.` : 'The sequence is over.');
  set(field, 'aria-label', `The sequence at step ${t}: ${now.textContent}`);
}

function bar(group, x, step, y, value, s, t, k) {
  if (!value) return;
  const top = Math.min(y(0), y(value)), part = add(group, 'rect', {class: s < t ? 'input' : 'input later',
    x: x + .15 * step, width: .7 * step, y: top, height: Math.abs(y(0) - y(value)), style: `fill: ${color(k)}`});
  add(part, 'title', {}, `step ${s}: ${number(value)}`);
}

/* The side on which the answer is right is shaded, darker where it counts. */
function answer(group, x, step, y, s, t) {
  const target = game.target[s], asked = game.scored[s];
  if (target) add(group, 'rect', {class: asked ? 'target asked' : 'target', x, width: step,
    y: target > 0 ? y(1) : y(0), height: y(0) - y(1)});
  if (s >= t) return;
  add(group, 'line', {class: 'answer', x1: x, x2: x + step, y1: y(game.answer[s]), y2: y(game.answer[s])});
  if (asked) add(group, 'circle', {class: game.right[s] ? 'dot yes' : 'dot no', cx: x + step / 2, cy: y(game.answer[s]), r: 3});
}

return {build, draw};
});
