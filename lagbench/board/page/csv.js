// What the table shows as a file: same rows, same columns, all digits.

/** Return lines of CSV (RFC 4180); text that a spreadsheet would run is quoted by an apostrophe. */
function csvOf(tab, state) {
  const keys = tab.presets[state.preset];
  const { floors, entries } = shownRows(tab, state);
  const ranking = tab.metrics.indexOf(tab.ranking);
  const head = ["rank", "method", "status", ...keys, `${tab.ranking}_low`, `${tab.ranking}_high`];
  const lines = [...floors, ...entries].map((row) => {
    const [, low, high] = row.values[ranking] ?? [];
    const cells = keys.map((name) => valueOf(tab, row, name));
    return [row.rank ?? "", row.name, row.floor ? "floor" : row.status, ...cells, number(low), number(high)];
  });
  return [head, ...lines].map((cells) => cells.map(csvCell).join(",")).join("\r\n") + "\r\n";
}

function csvCell(value) {
  if (typeof value === "number") return Number.isNaN(value) ? "" : String(value);
  const safe = value.replace(/(^|[;|\t\r\n])(\s*[=+\-@\uff1d\uff0b\uff0d\uff20\t\r])/g, "$1'$2");
  return /[",;\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}

function saveCsv(tab, state) {
  const address = URL.createObjectURL(new Blob([csvOf(tab, state)], { type: "text/csv" }));
  const link = el("a", { href: address, download: `lagbench-${tab.id}-${state.preset}.csv` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
}
