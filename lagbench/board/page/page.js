const specs = JSON.parse(document.getElementById("charts").textContent);
const sections = [...document.querySelectorAll("main > section")];

function draw(section) {
  for (const place of section.querySelectorAll("[data-chart]")) {
    const name = place.dataset.chart;
    if (!place.hasChildNodes() && name in specs) {
      vegaEmbed(place, specs[name], { renderer: "svg", actions: false });
    }
  }
}

// shows the data set that the address names, as in #cavity-mini or #cavity-mini.gns
function show() {
  const address = decodeURIComponent(location.hash.slice(1));
  const name = address.split(".")[0];
  const chosen = document.getElementById(`tab-${name}`) ?? sections[0];
  for (const section of sections) section.hidden = section !== chosen;
  for (const link of document.querySelectorAll("nav a")) {
    link.toggleAttribute("aria-current", `tab-${link.hash.slice(1)}` === chosen.id);
  }
  draw(chosen);
  const entry = document.getElementById(address);
  if (entry) {
    entry.open = true;
    entry.scrollIntoView();
  } else {
    scrollTo(0, 0);
  }
}

function sortBy(table, head) {
  const column = [...head.parentNode.children].indexOf(head);
  const isAscending = head.getAttribute("aria-sort") !== "ascending";
  for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", isAscending ? "ascending" : "descending");
  const sign = isAscending ? 1 : -1;
  const body = table.tBodies[0];
  const rows = [...body.rows].map((row) => {
    const cell = row.cells[column];
    const order = cell.dataset.order ? Number(cell.dataset.order) : NaN;
    return { row, order, text: cell.textContent.trim() };
  });
  // rows without a value come last in both directions
  rows.sort((a, b) => {
    if (Number.isNaN(a.order) !== Number.isNaN(b.order)) return Number.isNaN(a.order) ? 1 : -1;
    if (Number.isNaN(a.order)) return sign * a.text.localeCompare(b.text);
    return sign * (a.order - b.order);
  });
  body.append(...rows.map((entry) => entry.row));
}

for (const section of sections) {
  const table = section.querySelector(".sortable");
  if (!table) continue;
  const [search, withReferences] = section.querySelectorAll(".tools input");
  const group = section.querySelector(".tools select");
  const update = () => {
    const words = search.value.toLowerCase();
    for (const row of table.tBodies[0].rows) {
      const isLeftOut = row.className === "reference" && !withReferences.checked;
      row.hidden = isLeftOut || !row.textContent.toLowerCase().includes(words);
    }
    for (const cell of table.querySelectorAll("[data-group]")) {
      const keys = ["", group.value];
      cell.hidden = !keys.includes(cell.dataset.group);
    }
  };
  for (const tool of [search, withReferences, group]) tool.addEventListener("input", update);
  for (const head of table.tHead.rows[0].cells) {
    head.querySelector("button").addEventListener("click", () => sortBy(table, head));
  }
  update();
}

document.getElementById("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
  const current = root.dataset.theme ?? (isDark ? "dark" : "light");
  root.dataset.theme = current === "dark" ? "light" : "dark";
});
addEventListener("hashchange", show);
show();
