// What the reader chose, kept in the address so that it can be shared.

const OVERVIEW = "overview";

function tabOf(state) {
  return BOARD.tabs.find((tab) => tab.id === state.tab);
}

/** Tell whether an address is one of ours, not that of a place on the page. */
function isAddress(hash) {
  const text = hash.replace(/^#/, "");
  return !text || text.includes("tab=") || text === OVERVIEW || BOARD.tabs.some((tab) => tab.id === text);
}

/** Return the state that an address describes; what it does not know becomes the default. */
function readAddress(hash) {
  const text = hash.replace(/^#/, "");
  const given = new URLSearchParams(text.includes("=") ? text : `tab=${text}`);
  const tab = BOARD.tabs.find((one) => one.id === given.get("tab"));
  const sort = given.get("sort") ?? "rank";
  const state = { tab: tab?.id ?? OVERVIEW, preset: "main", sort: { key: "rank", down: false }, filter: "", inactive: false, entry: "", curve: "" };
  if (!tab) return state;
  const { presets } = tab;
  if (Object.hasOwn(presets, given.get("columns") ?? "")) state.preset = given.get("columns");
  const order = { key: sort.replace(/^-/, ""), down: sort.startsWith("-") };
  if (["rank", "name", ...presets[state.preset]].includes(order.key)) state.sort = order;
  state.filter = (given.get("filter") ?? "").slice(0, 200);
  state.inactive = given.get("inactive") === "1";
  state.entry = tab.rows.find((row) => row.id === given.get("entry"))?.id ?? "";
  state.curve = given.get("curve") ?? "";
  return state;
}

/** Return the address of a state; defaults are left out. */
function addressOf(state) {
  const parts = new URLSearchParams({ tab: state.tab });
  if (state.preset !== "main") parts.set("columns", state.preset);
  if (state.sort.key !== "rank" || state.sort.down) parts.set("sort", (state.sort.down ? "-" : "") + state.sort.key);
  if (state.filter) parts.set("filter", state.filter);
  if (state.inactive) parts.set("inactive", "1");
  for (const name of ["curve", "entry"]) {
    if (state[name]) parts.set(name, state[name]);
  }
  return `#${parts}`;
}
