// What the reader chose, kept in the address so that it can be shared.

function tabOf(state) {
  return BOARD.tabs.find((tab) => tab.id === state.tab);
}

/** Tell whether an address is one of ours, not that of a place on the page. */
function isAddress(hash) {
  const text = hash.replace(/^#/, "");
  return !text || text.includes("tab=") || BOARD.tabs.some((tab) => tab.id === text);
}

/** Return the state that an address describes; what it does not know becomes the default. */
function readAddress(hash) {
  const text = hash.replace(/^#/, "");
  const bare = BOARD.tabs.find((tab) => tab.id === text);
  const given = new URLSearchParams(bare ? `tab=${text}` : text);
  const tab = BOARD.tabs.find((one) => one.id === given.get("tab")) ?? BOARD.tabs[0];
  const preset = Object.hasOwn(tab.presets, given.get("columns") ?? "") ? given.get("columns") : "main";
  const sort = given.get("sort") ?? "rank";
  const order = { key: sort.replace(/^-/, ""), down: sort.startsWith("-") };
  const known = ["rank", "name", ...tab.presets[preset]].includes(order.key);
  const entry = tab.rows.find((row) => row.id === given.get("entry"))?.id ?? "";
  return {
    tab: tab.id,
    preset,
    sort: known ? order : { key: "rank", down: false },
    filter: (given.get("filter") ?? "").slice(0, 200),
    inactive: given.get("inactive") === "1",
    entry,
    cost: given.get("cost") ?? "",
    curve: given.get("curve") ?? "",
  };
}

/** Return the address of a state; defaults are left out. */
function addressOf(state) {
  const parts = new URLSearchParams({ tab: state.tab });
  if (state.preset !== "main") parts.set("columns", state.preset);
  if (state.sort.key !== "rank" || state.sort.down) parts.set("sort", (state.sort.down ? "-" : "") + state.sort.key);
  if (state.filter) parts.set("filter", state.filter);
  if (state.inactive) parts.set("inactive", "1");
  for (const name of ["cost", "curve", "entry"]) {
    if (state[name]) parts.set(name, state[name]);
  }
  return `#${parts}`;
}
