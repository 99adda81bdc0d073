// The table: which rows, in which order, which columns.

function columnOf(keyName) {
  return BOARD.columns[keyName];
}

/** Return what a row has in a column: a number, or text. */
function valueOf(tab, row, keyName) {
  const place = tab.metrics.indexOf(keyName);
  if (place >= 0) return number(row.values[place]?.[0]);
  if (keyName === "date") return row.date;
  if (keyName === "device") return row.cost?.device ?? "";
  if (keyName === "seeds") return row.floor ? NaN : row.seeds;
  return number(keyName === "parameters" ? row.parameters : row.cost?.[keyName]);
}

/** Return a number that is smaller the better it is; NaN for what is not judged. */
function lossOf(keyName, value) {
  const { direction, perfect } = columnOf(keyName);
  if (direction === "lower") return value;
  if (direction === "higher") return -value;
  return direction === "target" ? Math.abs(value - perfect) : NaN;
}

function isActive(row) {
  return row.status === "active" && row.current;
}

/** Return the floors, and the entries that are shown, in order. */
function shownRows(tab, state) {
  const terms = state.filter.toLowerCase().split(/\s+/).filter(Boolean);
  const matches = (row) => {
    const text = [row.name, row.authors, row.affiliation, row.training, row.hardware, row.cost?.device, row.date];
    const whole = text.join(" ").toLowerCase();
    return terms.every((term) => whole.includes(term));
  };
  const entries = tab.rows.filter((row) => !row.floor && (state.inactive || isActive(row)) && matches(row));
  return { floors: tab.rows.filter((row) => row.floor), entries: ordered(tab, entries, state.sort) };
}

/** Return rows sorted; those without a value come last whichever way. */
function ordered(tab, rows, { key: by, down }) {
  const places = new Map(tab.rows.map((row, i) => [row, i]));
  const sign = down ? -1 : 1;
  const of = (row) => {
    if (by === "rank") return row.rank ?? NaN;
    if (by === "name") return row.name.toLowerCase();
    const value = valueOf(tab, row, by);
    return columnOf(by).direction === "target" ? lossOf(by, value) : value;
  };
  return rows
    .map((row) => [row, of(row)])
    .sort(([one, a], [two, b]) => {
      const gaps = isGap(a) - isGap(b);
      const apart = a < b ? -sign : a > b ? sign : 0;
      return gaps || apart || places.get(one) - places.get(two);
    })
    .map(([row]) => row);
}

function isGap(value) {
  return Number(value === "" || Number.isNaN(value));
}

/** Return the order after a click on a heading: best first, then worst first. */
function nextSort(by, sort) {
  const first = by !== "rank" && by !== "name" && ["higher", "none"].includes(columnOf(by).direction) && columnOf(by).form !== "text";
  return sort.key === by ? { key: by, down: !sort.down } : { key: by, down: first };
}

function drawTable(tab, state, act) {
  const keys = tab.presets[state.preset];
  const { floors, entries } = shownRows(tab, state);
  const shades = new Map(keys.map((name) => [name, shadesOf(tab, entries, name)]));
  const line = (row) => drawRow(tab, state, row, keys, shades);
  const empty = el("tr", {}, el("td", { class: "empty", colspan: keys.length + 2 }, "No entry matches."));
  return el(
    "table",
    { class: "board" },
    el("caption", { class: "unseen" }, `${tab.split} ${tab.size}: methods and scores`),
    el("thead", {}, el("tr", {}, [
      heading("rank", "#", [], "Rank by the ranking metric", state, act, "rank"),
      heading("name", "method", [], "Name of the method", state, act, "method"),
      keys.map((name) => {
        const { label, unit, direction, meaning, form, reported } = columnOf(name);
        const below = [`${unit} ${ARROWS[direction]}`.trim(), reported ? "self\u2011reported" : ""];
        return heading(name, label, below, meaning, state, act, form === "text" ? "words" : null);
      }),
    ])),
    el("tbody", { class: "floors" }, floors.map(line)),
    el("tbody", { class: "entries" }, entries.length ? entries.map(line) : empty),
  );
}

const ARROWS = { lower: "↓", higher: "↑", target: "◎", none: "" };

function heading(by, label, below, meaning, state, act, kind) {
  const sorted = state.sort.key === by ? (state.sort.down ? "descending" : "ascending") : null;
  const sorter = button([el("span", { class: "metric" }, label), below.filter(Boolean).map((text) => el("span", { class: "unit" }, text))], () => act.sort(by), {
    class: "sorter",
    title: meaning,
    "data-sort": by,
  });
  return el("th", { scope: "col", class: kind, "aria-sort": sorted }, sorter);
}

function drawRow(tab, state, row, keys, shades) {
  const by = [row.authors, row.affiliation].filter(Boolean).join(" · ");
  const kind = [row.floor ? "floor" : "", isActive(row) || row.floor ? "" : "inactive"].join(" ").trim();
  return el(
    "tr",
    { class: kind || null, "data-entry": row.id },
    el("td", { class: "rank" }, rankText(row)),
    el("th", { scope: "row", class: "method" }, [
      el("a", { href: addressOf({ ...state, entry: row.id }), class: "name" }, row.name),
      chips(row),
      el("span", { class: "sub", title: by }, row.floor ? "floor, computed by the scorer" : by),
    ]),
    keys.map((name) => drawCell(tab, row, name, shades.get(name))),
  );
}

function rankText(row) {
  if (row.rank === null) return row.floor ? "" : MISSING;
  return row.shared ? `=${row.rank}` : String(row.rank);
}

function drawCell(tab, row, name, { level, best }) {
  const value = valueOf(tab, row, name);
  const column = columnOf(name);
  const [, low, high, std, undefinedFrames] = row.values[tab.metrics.indexOf(name)] ?? [];
  const ranks = name === tab.ranking;
  const interval = low === null || low === undefined ? "" : `${written(number(low))} … ${written(number(high))}`;
  const told = [interval && `95 % interval ${interval}`, std ? `± ${written(std)} over seeds` : "", undefinedFrames ? `${undefinedFrames} frames undefined` : ""];
  const shade = row.floor || !isActive(row) ? null : level(value);
  const classes = [column.form === "text" ? "words" : "", shade === null ? "" : `heat${shade}`, best.has(row) ? "best" : ""];
  return el(
    "td",
    { class: classes.filter(Boolean).join(" ") || null, title: told.filter(Boolean).join("; ") || null, "data-key": name },
    el("span", { class: "n" }, cellText(value, column.form)),
    undefinedFrames && !Number.isNaN(value) ? el("sup", {}, "†") : null,
    ranks && interval ? el("span", { class: "ci" }, interval) : null,
  );
}

/** Return shade (0 is best, 4 worst) by value and the best rows of a column. */
function shadesOf(tab, rows, name) {
  const judged = rows.filter(isActive).map((row) => [row, lossOf(name, valueOf(tab, row, name))]).filter(([, loss]) => Number.isFinite(loss));
  const losses = judged.map(([, loss]) => loss);
  const low = Math.min(...losses);
  const high = Math.max(...losses);
  const bend = low > 0 ? Math.log : (loss) => loss;
  const level = (value) => {
    const loss = lossOf(name, value);
    if (!(high > low) || !Number.isFinite(loss) || losses.length < 3) return null;
    return Math.min(4, Math.floor((5 * (bend(loss) - bend(low))) / (bend(high) - bend(low))));
  };
  return { level, best: new Set(judged.filter(([, loss]) => loss === low && losses.length > 1).map(([row]) => row)) };
}

/** Return small marks beside a name: status, data set version, flags. */
function chips(row) {
  const said = [];
  if (row.status !== "active") said.push(["unknown", row.status, row.reason || `This entry is ${row.status}.`]);
  if (!row.current) said.push(["unknown", `data ${row.version}`, "Scored on a data set version that is no longer current."]);
  for (const [name, reasons] of row.flags) said.push(["bad", labelOf(name), flagText(name, reasons)]);
  for (const [name, reasons] of row.warnings) said.push(["warn", labelOf(name), flagText(name, reasons)]);
  if (row.diverged) said.push(["warn", "diverged", `${row.diverged} rollouts are frozen at their last finite frame.`]);
  return said.map(([kind, label, text]) => el("span", { class: `flag ${kind}`, title: text }, label));
}

function words(name) {
  return name.replaceAll("_", " ");
}

/** Return label and meaning of a flag or warning; an unknown one is called as the scorer does. */
function explained(name) {
  return Object.hasOwn(BOARD.explained, name) ? BOARD.explained[name] : [words(name), ""];
}

function labelOf(name) {
  return explained(name)[0];
}

function flagText(name, reasons) {
  const meaning = explained(name)[1];
  if (!reasons.length) return meaning;
  return `${meaning && `${meaning.replace(/\.$/, "")}: `}${reasons.join("; ")}.`;
}
