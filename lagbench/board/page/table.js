// The table is drawn in lagbench/board/table.py; here its rows are sorted and filtered, its cells shown or hidden.

function sectionOf(tab) {
  return document.getElementById(tab.id);
}

/** Return the keys of each preset of columns. */
function presetsOf(tab) {
  return (tab.presets ??= Object.fromEntries([...sectionOf(tab).querySelectorAll("[data-preset]")].map((one) => [one.dataset.preset, one.dataset.keys.split(" ")])));
}

/** Return columns by key: place in a row, label, quantity, direction, form. */
function columnsOf(tab) {
  const described = (head, place) => {
    const key = head.querySelector("[data-sort]").dataset.sort;
    const label = head.querySelector(".metric").textContent;
    const quantity = head.dataset.unit ? `${label} [${head.dataset.unit}]` : label;
    return [key, { form: "number", ...head.dataset, key, label, quantity, place, head }];
  };
  return (tab.columns ??= Object.fromEntries([...sectionOf(tab).querySelectorAll("thead th")].map(described)));
}

function columnOf(tab, key) {
  return columnsOf(tab)[key];
}

/** Return the line of the table for an entry or a floor. */
function lineOf(tab, row) {
  return (row.line ??= sectionOf(tab).querySelector(`tr[data-entry="${CSS.escape(row.id)}"], tr[data-floor="${CSS.escape(row.id)}"]`));
}

function cellOf(tab, row, key) {
  return lineOf(tab, row).cells[columnOf(tab, key).place];
}

/** Return what a row has in a column: a number, or text. */
function valueOf(tab, row, key) {
  const { value } = cellOf(tab, row, key).dataset;
  if (columnOf(tab, key).form === "text") return value ?? "";
  return value === undefined ? NaN : Number(value);
}

function textOf(tab, row, key) {
  return cellOf(tab, row, key).firstChild.textContent;
}

/** Return the entries that are shown, in order, and all that could be. */
function shownRows(tab, state) {
  const terms = state.filter.toLowerCase().split(/\s+/).filter(Boolean);
  const matches = (row) => {
    const line = lineOf(tab, row);
    const whole = `${line.textContent} ${line.dataset.more}`.toLowerCase();
    return terms.every((term) => whole.includes(term));
  };
  const every = tab.rows.filter((row) => state.inactive || row.active);
  return { every, entries: ordered(tab, every.filter(matches), state.sort) };
}

/** Return rows sorted; those without a value come last whichever way. */
function ordered(tab, rows, { key: by, down }) {
  const sign = down ? -1 : 1;
  const of = (row) => {
    if (by === "rank" || by === "name") return by === "rank" ? placeOf(tab, row) : cellOf(tab, row, by).dataset.value;
    const target = columnOf(tab, by).direction === "target"; // the nearer the better
    return target ? Number(cellOf(tab, row, by).dataset.loss ?? NaN) : valueOf(tab, row, by);
  };
  return rows
    .map((row) => [row, of(row)])
    .sort(([one, a], [two, b]) => {
      const gaps = isGap(a) - isGap(b);
      const apart = a < b ? -sign : a > b ? sign : 0;
      return gaps || apart || placeOf(tab, one) - placeOf(tab, two);
    })
    .map(([row]) => row);
}

/** Return where a row stands in the order of the ranking metric. */
function placeOf(tab, row) {
  return Number(lineOf(tab, row).cells[0].dataset.value);
}

function isGap(value) {
  return Number(value === "" || Number.isNaN(value));
}

/** Return the order after a click on a heading: best first, then worst first. */
function nextSort(tab, by, sort) {
  const { direction, form } = columnOf(tab, by);
  const first = by !== "rank" && by !== "name" && ["higher", "none"].includes(direction) && form !== "text";
  return sort.key === by ? { key: by, down: !sort.down } : { key: by, down: first };
}

/** Show the rows and columns that were asked for, in order; return the entries shown and all that could be. */
function arrange(tab, state) {
  const keys = new Set(["rank", "name", ...presetsOf(tab)[state.preset]]);
  const { every, entries } = shownRows(tab, state);
  const columns = Object.values(columnsOf(tab));
  for (const { key, head } of columns) {
    head.hidden = !keys.has(key);
    if (key === state.sort.key) head.ariaSort = state.sort.down ? "descending" : "ascending";
    else head.removeAttribute("aria-sort");
  }
  const shown = new Set([...tab.floors, ...entries]);
  const all = [...tab.floors, ...tab.rows];
  for (const row of all) {
    const line = lineOf(tab, row);
    line.hidden = !shown.has(row);
    columns.forEach(({ key }, place) => { line.cells[place].hidden = !keys.has(key); });
  }
  sectionOf(tab).querySelector("tbody").append(...ordered(tab, all, state.sort).map((row) => lineOf(tab, row)));
  return { every, entries };
}

/** Return the table as it is shown, as lines of CSV (RFC 4180) with all digits. */
function csvOf(tab, state) {
  const keys = presetsOf(tab)[state.preset];
  const head = ["rank", "method", "status", ...keys, `${tab.ranking}_low`, `${tab.ranking}_high`];
  const lines = [...sectionOf(tab).querySelectorAll("tbody tr:not([hidden])")].map((line) => {
    const [rank] = line.cells;
    const { low, high } = line.cells[columnOf(tab, tab.ranking).place].dataset;
    const status = line.dataset.floor ? "floor" : line.className || "active";
    const cells = keys.map((name) => line.cells[columnOf(tab, name).place].dataset.value ?? "");
    return [Number.parseInt(rank.textContent, 10) || "", line.querySelector(".name").textContent, status, ...cells, low ?? "", high ?? ""];
  });
  return [head, ...lines].map((cells) => cells.map(csvCell).join(",")).join("\r\n") + "\r\n";
}

/** Return a cell; text that a spreadsheet would run is quoted by an apostrophe. */
function csvCell(value) {
  const text = String(value);
  if (/^-?[\d.]+(e[-+]?\d+)?$/.test(text)) return text;
  const safe = text.replace(/(^|[;|\t\r\n])(\s*[=+\-@\uff1d\uff0b\uff0d\uff20\t\r])/g, "$1'$2");
  return /[",;\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}

function saveCsv(tab, state) {
  const address = URL.createObjectURL(new Blob([csvOf(tab, state)], { type: "text/csv" }));
  const link = el("a", { href: address, download: `lagbench-${tab.id}-${state.preset}.csv` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
}
