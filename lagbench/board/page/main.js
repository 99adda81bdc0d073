// Puts the parts together: tabs, tools, the table, the panel.

let state = readAddress(location.hash);
let film = null;
let opener = null;
const panel = document.getElementById("panel");
const act = {
  sort: (by) => change({ sort: nextSort(tabOf(state), by, state.sort) }, `th [data-sort="${by}"]`),
  curve: (curve) => change({ curve }, '[data-figure="lines"] select'),
};

function section() {
  return document.getElementById(state.tab);
}

/** Take over a change, keep it in the address, draw; the focus stays where it was. */
function change(changes, focus = null) {
  state = { ...state, ...changes };
  history.replaceState(null, "", addressOf(state));
  draw();
  if (focus) section().querySelector(focus)?.focus();
}

function draw() {
  for (const one of document.querySelectorAll("section.tab")) one.hidden = one.id !== state.tab;
  for (const link of document.querySelectorAll(".tabs a")) {
    const chosen = link.dataset.tab === state.tab;
    link.setAttribute("aria-selected", chosen);
    link.tabIndex = chosen ? 0 : -1;
  }
  const tab = tabOf(state);
  setHero(tab);
  if (!tab) return;
  const tools = section().querySelector(".tools");
  const filter = tools.querySelector("input[type=search]");
  if (filter.value !== state.filter) filter.value = state.filter;
  for (const one of tools.querySelectorAll("[data-preset]")) one.setAttribute("aria-pressed", one.dataset.preset === state.preset);
  const inactive = tools.querySelector("input[type=checkbox]");
  if (inactive) inactive.checked = state.inactive;
  const { every, entries } = arrange(tab, state);
  const figures = section().querySelector(".figures");
  figures.replaceChildren(figures.querySelector('[data-figure="cost"]'), drawLines(tab, state, entries, act));
  const of = entries.length === every.length ? "" : `${entries.length} of `;
  tools.querySelector(".count").textContent = `${of}${every.length} ${every.length === 1 ? "entry" : "entries"}`;
}

/** Give the tools and headings of a tab their work. */
function linkTools(tab) {
  const whole = sectionOf(tab);
  const filter = whole.querySelector("input[type=search]");
  filter.addEventListener("input", () => change({ filter: filter.value.slice(0, 200) }));
  for (const one of whole.querySelectorAll("[data-preset]")) one.addEventListener("click", () => choosePreset(one.dataset.preset));
  for (const one of whole.querySelectorAll("[data-sort]")) one.addEventListener("click", () => act.sort(one.dataset.sort));
  const inactive = whole.querySelector(".tools input[type=checkbox]");
  inactive?.addEventListener("change", () => change({ inactive: inactive.checked }));
  whole.querySelector(".csv").addEventListener("click", () => saveCsv(tab, state));
  // what is too long for its place is read in full under the pointer
  for (const one of whole.querySelectorAll(".board .sub")) one.title = one.textContent;
  for (const name of whole.querySelectorAll("tr[data-entry] .name")) {
    name.addEventListener("click", (event) => {
      event.preventDefault();
      location.hash = addressOf({ ...state, entry: name.closest("tr").dataset.entry });
    });
  }
}

function choosePreset(name) {
  const { key: by } = state.sort;
  const kept = ["rank", "name", ...tabOf(state).presets[name]].includes(by);
  change({ preset: name, sort: kept ? state.sort : { key: "rank", down: false } }, `[data-preset="${name}"]`);
}

function openPanel() {
  const tab = tabOf(state);
  const row = tab.rows.find((one) => one.id === state.entry);
  film?.stop();
  let content;
  [content, film] = drawDetail(tab, state, row);
  const { entries } = shownRows(tab, state);
  const listed = entries.includes(row) ? entries : [row];
  const step = (by) => addressOf({ ...state, entry: listed[(listed.indexOf(row) + by + listed.length) % listed.length].id });
  const move = (label, sign, by) => el("a", { href: step(by), class: "plain", "aria-label": label }, sign);
  panel.replaceChildren(
    el("header", { class: "panel-head" }, [
      el("div", {}, [
        el("p", { class: "brand" }, `${tab.split} · ${tab.size}`),
        el("h2", { id: "panel-title", tabindex: -1 }, row.name),
        drawByline(row),
        el("p", { class: "muted" }, row.standing),
      ]),
      el("nav", { "aria-label": "Entries" }, move("Previous entry", "←", -1), move("Next entry", "→", 1), button("Close", () => panel.close(), { class: "plain" })),
    ]),
    el("div", { class: "panel-body" }, content),
  );
  if (!panel.open) panel.showModal();
  panel.scrollTop = 0;
  panel.querySelector("h2").focus();
  playHero();
  if (!quiet.matches) film?.toggle(true);
}

panel.addEventListener("close", () => {
  film?.stop();
  film = null;
  const back = state.entry || opener;
  panel.replaceChildren();
  playHero();
  if (state.entry) change({ entry: "" });
  if (back) section().querySelector(`[data-entry="${CSS.escape(back)}"] a.name`)?.focus();
});
panel.addEventListener("click", (event) => {
  if (event.target === panel) panel.close();
});

/** Follow the address: after a link, back, forward, or an address typed in. */
function follow() {
  state = readAddress(isAddress(location.hash) ? location.hash : "");
  draw();
  if (state.entry) {
    opener = state.entry;
    openPanel();
  } else if (panel.open) panel.close();
}

/** Return the state of a tab just opened: what is hidden stays as it was. */
function fresh(tab) {
  return { ...readAddress(`#${tab}`), inactive: state.inactive };
}

function linkTabs() {
  const links = [...document.querySelectorAll(".tabs a")];
  document.querySelector(".tabs").setAttribute("role", "tablist");
  for (const link of links) {
    const name = link.dataset.tab;
    fill(link, { role: "tab", id: `tab-${name}`, "aria-controls": name }, []);
    fill(document.getElementById(name), { role: "tabpanel", "aria-labelledby": `tab-${name}` }, []);
    link.addEventListener("click", (event) => {
      event.preventDefault();
      if (link.dataset.tab !== state.tab) location.hash = addressOf(fresh(link.dataset.tab));
    });
    link.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      const end = { Home: 0, End: links.length - 1 }[event.key];
      if (step === undefined && end === undefined) return;
      event.preventDefault();
      const next = links[end ?? (links.indexOf(link) + step + links.length) % links.length];
      next.focus();
      next.click();
    });
  }
}

function linkTheme() {
  const toggle = document.getElementById("theme");
  const root = document.documentElement;
  const show = () => {
    toggle.textContent = { light: "☀ Light", dark: "☾ Dark" }[root.dataset.theme] ?? "◐ Auto";
    document.dispatchEvent(new Event("schemechange"));
  };
  toggle.addEventListener("click", () => {
    const next = { light: "dark", dark: "" }[root.dataset.theme] ?? "light";
    if (next) root.dataset.theme = next;
    else delete root.dataset.theme;
    try {
      localStorage.setItem("lagbench-theme", next);
    } catch {
      // storage may be forbidden: the choice holds until the page is closed
    }
    show();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);
  show();
}

/** A click anywhere in a row opens it. */
document.addEventListener("click", (event) => {
  const row = event.target.closest?.("tr[data-entry]");
  if (row && !event.target.closest("a, button") && !String(getSelection())) row.querySelector("a.name").click();
});
document.addEventListener("keydown", (event) => {
  if (event.key === "/" && !panel.open && !/^(input|select|textarea)$/i.test(event.target.tagName)) {
    event.preventDefault();
    section()?.querySelector(".tools input")?.focus();
  }
});

if (BOARD.tabs.length) {
  linkTabs();
  BOARD.tabs.forEach(linkTools);
  linkFolds();
  window.addEventListener("hashchange", () => isAddress(location.hash) && follow());
  follow();
}
linkTheme();
document.documentElement.dataset.ready = "";
