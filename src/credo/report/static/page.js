/* Legends that toggle curves, and tooltips. A page without this script shows everything but the
   tooltips. */
(() => {
  const nearest = (xs, x) =>
    xs.reduce((best, at, i) => Math.abs(at - x) < Math.abs(xs[best] - x) ? i : best, 0);

  /* Lines of a tooltip: [colour or null, text], and where its guide stands, as a share of the
     axes' width. `u` and `v`: where the pointer is, from the left and from the top. */
  function ofCurves(tips, buttons, u) {
    const [low, high] = tips.x, x = low + u * (high - low);
    const lines = [];
    let at = null;
    tips.curves.forEach((curve, i) => {
      const button = buttons.find(button => button.dataset.curve === String(i));
      if (button && button.getAttribute('aria-pressed') === 'false') return;
      const k = nearest(curve.x, x);
      at ??= curve.x[k];
      const color = button ? getComputedStyle(button.querySelector('path')).stroke : null;
      if (curve.text[k]) lines.push([color, `${button ? button.textContent : ''} ${curve.text[k]}`]);
    });
    if (at === null) return null;
    const number = at.toLocaleString('en', {maximumSignificantDigits: 6});
    const share = (at - low) / (high - low);
    return {lines: [[null, `${tips.name} ${number}`], ...lines], share};
  }

  function ofCells(tips, u, v) {
    const row = Math.min(tips.rows.length - 1, Math.floor(v * tips.rows.length));
    const column = Math.min(tips.columns.length - 1, Math.floor(u * tips.columns.length));
    const place = [[null, `${tips.rows[row]}, ${tips.columns[column]}`]];
    return {lines: [...place, [null, tips.values[row][column]]], share: null};
  }

  function show(figure, tips, buttons, event) {
    const plot = figure.querySelector('.plot'), area = plot.getBoundingClientRect();
    const [left, top, width, height] = tips.box;
    const u = ((event.clientX - area.left) / area.width - left) / width;
    const v = ((event.clientY - area.top) / area.height - top) / height;
    plot.querySelectorAll('.tip, .guide').forEach(node => node.remove());
    if (u < 0 || u > 1 || v < 0 || v > 1) return;
    const told = tips.curves ? ofCurves(tips, buttons, u) : ofCells(tips, u, v);
    if (!told) return;
    const tip = plot.appendChild(document.createElement('div'));
    tip.className = 'tip';
    told.lines.forEach(([color, text], i) => {
      const line = tip.appendChild(document.createElement(i ? 'div' : 'b'));
      if (color) line.appendChild(document.createElement('i')).style.background = color;
      line.append(text);
    });
    const x = event.clientX - area.left, y = event.clientY - area.top;
    const side = x > area.width / 2 ? x - tip.offsetWidth - 12 : x + 12;
    tip.style.left = `${Math.max(0, Math.min(area.width - tip.offsetWidth, side))}px`;
    tip.style.top = `${Math.max(0, y - tip.offsetHeight - 12)}px`;
    if (told.share === null) return;
    const guide = plot.appendChild(document.createElement('div'));
    guide.className = 'guide';
    const percent = {left: left + width * told.share, top, height};
    for (const name in percent) guide.style[name] = `${100 * percent[name]}%`;
  }

  for (const figure of document.querySelectorAll('figure[data-tips]')) {
    const tips = JSON.parse(figure.dataset.tips);
    const plot = figure.querySelector('.plot');
    const buttons = [...figure.querySelectorAll('.legend button')];
    for (const button of buttons) button.addEventListener('click', () => {
      const on = button.getAttribute('aria-pressed') === 'false';
      button.setAttribute('aria-pressed', on);
      figure.querySelectorAll(`[id*="-curve-${button.dataset.curve}-"]`)
        .forEach(part => { part.style.display = on ? '' : 'none'; });
    });
    for (const kind of ['pointermove', 'pointerdown'])
      plot.addEventListener(kind, event => show(figure, tips, buttons, event));
    plot.addEventListener('pointerleave', () =>
      plot.querySelectorAll('.tip, .guide').forEach(node => node.remove()));
  }
})();
