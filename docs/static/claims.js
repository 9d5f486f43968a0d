// The page of claims can be filtered: by verdict, and by words. Without scripts all rows are shown.
document.addEventListener("DOMContentLoaded", () => {
  const tables = [...document.querySelectorAll("table")].filter((table) =>
    [...table.querySelectorAll("th")].some((cell) => cell.textContent.trim() === "verdict")
  );
  if (!tables.length) return;
  const rows = tables.flatMap((table) => [...table.querySelectorAll("tbody tr")]);
  const verdict = (row) => row.cells[6].querySelector("strong").textContent.trim();
  const choice = document.createElement("select");
  choice.setAttribute("aria-label", "Verdict");
  for (const name of ["all verdicts", ...new Set(rows.map(verdict))]) choice.add(new Option(name));
  const words = document.createElement("input");
  words.type = "search";
  words.placeholder = "words, such as Hopper or Figure 5.3";
  words.setAttribute("aria-label", "Words");
  const shown = document.createElement("span");
  shown.setAttribute("aria-live", "polite");
  const filter = () => {
    const wanted = words.value.toLowerCase().split(/\s+/);
    let count = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      const fits = choice.selectedIndex === 0 || verdict(row) === choice.value;
      row.hidden = !(fits && wanted.every((word) => text.includes(word)));
      count += row.hidden ? 0 : 1;
    }
    shown.textContent = ` ${count} of ${rows.length} claims`;
  };
  choice.addEventListener("change", filter);
  words.addEventListener("input", filter);
  const bar = document.createElement("p");
  bar.className = "claims-filter";
  bar.append(choice, words, shown);
  const first = tables[0].closest(".table-wrapper") ?? tables[0];
  const section = first.closest("section");
  section.before(bar);
  filter();
});
