// The table is drawn in lagbench/board/table.py. Here its lines are sorted and filtered, and its columns shown or hidden,
// by the data of the page; no number is read from a cell.

// Cells before those of the columns: rank and name.
const FIRST_CELLS = ["rank", "name"];

function sectionOf(tab) {
  return document.getElementById(tab.id);
}

/** Return where a column stands among the columns of the data. */
function indexOf(tab, key) {
  tab.indices ??= new Map(tab.columns.map((column, index) => [column.key, index]));
  return tab.indices.get(key);
}

function columnOf(tab, key) {
  return tab.columns[indexOf(tab, key)];
}

/** Return the keys of all cells of a line. */
function cellKeys(tab) {
  return [...FIRST_CELLS, ...tab.columns.map((column) => column.key)];
}

/** Return the line of the table for an entry or a reference predictor. */
function lineOf(tab, row) {
  const id = CSS.escape(row.id);
  row.line ??= sectionOf(tab).querySelector(`tr[data-entry="${id}"], tr[data-reference="${id}"]`);
  return row.line;
}

/** Return the value of a row in a column: a number, or text. */
function valueOf(tab, row, key) {
  const value = row.values[indexOf(tab, key)];
  return columnOf(tab, key).form === "text" ? value : number(value);
}

function textOf(tab, row, key) {
  return row.texts[indexOf(tab, key)];
}

function noteOf(tab, row, key) {
  return row.notes[indexOf(tab, key)] ?? "";
}

/** Return the entries that are shown, in order, and all that could be. */
function shownRows(tab, state) {
  const terms = state.filter.toLowerCase().split(/\s+/).filter(Boolean);
  const every = tab.rows.filter((row) => state.inactive || row.active);
  const matching = every.filter((row) => terms.every((term) => row.search.includes(term)));
  return { every, entries: ordered(tab, matching, state.sort) };
}

/** Return the value by which a row is sorted. */
function sortValue(tab, row, key) {
  if (key === "rank") return row.place;
  if (key === "name") return row.name.toLowerCase();
  // Of a metric that aims at a value, nearer is better.
  if (columnOf(tab, key).direction === "target") return number(row.losses[indexOf(tab, key)]);
  return valueOf(tab, row, key);
}

/** Return rows sorted; those without a value come last whichever way. */
function ordered(tab, rows, { key, down }) {
  const sign = down ? -1 : 1;
  const methods = new Map(rows.map((row) => [row.id, row]));
  const variants = rows.filter((row) => row.active && methods.has(row.variantOf));
  const pairs = rows.filter((row) => !variants.includes(row)).map((row) => [row, sortValue(tab, row, key)]);
  pairs.sort(([first, a], [second, b]) => {
    const gaps = isGap(a) - isGap(b);
    if (gaps) return gaps;
    if (a < b) return -sign;
    if (a > b) return sign;
    return first.place - second.place;
  });
  // variants stand behind their method, best first
  return pairs.flatMap(([row]) => [row, ...variants.filter((variant) => variant.variantOf === row.id)]);
}

function isGap(value) {
  return Number(value === "" || Number.isNaN(value));
}

/** Return the order after a click on a heading: best first, then worst first. */
function nextSort(tab, key, sort) {
  if (sort.key === key) return { key, down: !sort.down };
  if (FIRST_CELLS.includes(key)) return { key, down: false };
  const { direction, form } = columnOf(tab, key);
  return { key, down: ["higher", "none"].includes(direction) && form !== "text" };
}

/** Return the heading of a column; lagbench/board/table.py draws those that are shown at first. */
function headingCell({ key, label, marks, meaning, form }) {
  const units = marks.map((mark) => el("span", { class: "unit" }, mark));
  const sorter = el("button", { type: "button", class: "sorter", "data-sort": key, title: meaning }, el("span", { class: "metric" }, label), units);
  sorter.addEventListener("click", () => act.sort(key));
  return el("th", { scope: "col", class: form === "text" ? "words" : null }, sorter);
}

/** Return the headings of a tab by key; those that are not in the page yet are made. */
function headsOf(tab) {
  if (tab.heads) return tab.heads;
  const row = sectionOf(tab).querySelector("thead tr");
  tab.heads = new Map([...row.cells].map((cell) => [cell.querySelector("[data-sort]").dataset.sort, cell]));
  for (const column of tab.columns) {
    if (!tab.heads.has(column.key)) tab.heads.set(column.key, headingCell(column));
  }
  row.append(...cellKeys(tab).map((key) => tab.heads.get(key)));
  return tab.heads;
}

/** Return the cells of a line by key; those that are not in the page yet are made when asked for. */
function cellsOf(tab, row) {
  if (!row.cells) {
    const shown = [...FIRST_CELLS, ...tab.columns.map((column) => column.key).filter((key) => tab.presets.main.includes(key))];
    const cells = [...lineOf(tab, row).cells];
    row.cells = new Map(shown.map((key, place) => [key, cells[place]]));
  }
  return row.cells;
}

/** Add the cells of all columns that the page did not bring. */
function completeLine(tab, row) {
  const cells = cellsOf(tab, row);
  let before = null;
  for (const key of cellKeys(tab)) {
    if (!cells.has(key)) {
      const index = indexOf(tab, key);
      const attributes = { class: row.classes[index], title: row.notes[index] };
      const cell = el("td", attributes, textOf(tab, row, key));
      before.after(cell);
      cells.set(key, cell);
    }
    before = cells.get(key);
  }
}

/** Show the lines and columns that were asked for, in order; return the entries shown and all that could be. */
function arrange(tab, state) {
  const shownKeys = new Set([...FIRST_CELLS, ...tab.presets[state.preset]]);
  for (const [key, head] of headsOf(tab)) {
    head.hidden = !shownKeys.has(key);
    if (key === state.sort.key) head.ariaSort = state.sort.down ? "descending" : "ascending";
    else head.removeAttribute("aria-sort");
  }

  const { every, entries } = shownRows(tab, state);
  const shown = new Set([...tab.references, ...entries]);
  const rows = [...tab.references, ...tab.rows];
  const isMain = state.preset === "main";
  for (const row of rows) {
    lineOf(tab, row).hidden = !shown.has(row);
    if (!isMain) completeLine(tab, row);
    for (const [key, cell] of cellsOf(tab, row)) cell.hidden = !shownKeys.has(key);
  }
  // a filter that finds a variant shows it
  for (const row of rows) {
    if (row.variantOf && row.active) lineOf(tab, row).classList.toggle("found", Boolean(state.filter) && shown.has(row));
  }
  const lines = ordered(tab, rows, state.sort).map((row) => lineOf(tab, row));
  sectionOf(tab).querySelector("tbody").append(...lines);
  return { every, entries };
}

/** Return the table as it is shown, as lines of CSV (RFC 4180) with all digits. */
function csvOf(tab, state) {
  const keys = tab.presets[state.preset];
  const head = ["rank", "method", "status", ...keys, `${tab.ranking}_low`, `${tab.ranking}_high`];
  const { entries } = shownRows(tab, state);
  const lines = ordered(tab, [...tab.references, ...entries], state.sort).map((row) => {
    const values = keys.map((key) => row.values[indexOf(tab, key)] ?? "");
    const [low, high] = row.interval;
    return [row.rank ?? "", row.name, row.status, ...values, low ?? "", high ?? ""];
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
