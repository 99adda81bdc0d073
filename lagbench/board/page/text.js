// Numbers as readers like them, and elements whose text is never markup.

const MISSING = "–";
const RAISED = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };

/** Return a number of the page data: null stands for NaN, text for what is infinite. */
function number(value) {
  return value === null || value === undefined ? NaN : Number(value);
}

function power(exponent) {
  return "10" + [...String(exponent)].map((digit) => RAISED[digit]).join("");
}

function minus(text) {
  return text.replaceAll("-", "−");
}

/** Return a number with so many significant digits: 0.0123, −2.50×10⁻⁷, 20. */
function written(value, digits = 3) {
  if (Number.isNaN(value)) return MISSING;
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  if (value === 0) return "0";
  if (Number.isInteger(value) && Math.abs(value) < 1e5) return minus(String(value));
  const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
  const order = Number(exponent);
  if (order < -3 || order >= 5) return `${minus(mantissa)}×${power(order)}`;
  return minus(Number(`${mantissa}e${order}`).toFixed(Math.max(0, digits - 1 - order)));
}

function decimals(values, step) {
  let places = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  while (places < 9 && Math.abs(Number(step.toFixed(places)) - step) > 1e-9 * step) places += 1;
  return values.map((value) => (Math.abs(value) > step / 1e6 ? minus(value.toFixed(places)) : "0"));
}

/** Return an element; children that are no nodes become text, empty ones are left out. */
function el(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

function svg(name, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) element.setAttribute(name, "");
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value);
  }
  const kept = children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== "");
  element.append(...kept);
  return element;
}

/** Return a link that leaves the page, or plain text where the address is not of the web. */
function outward(address, label) {
  if (!/^https?:\/\/[^\s]+$/i.test(address ?? "")) return address ? el("span", {}, `${label}: ${address}`) : null;
  return el("a", { href: address, rel: "noopener noreferrer nofollow", target: "_blank" }, label);
}

/** Return a name short enough for a key. */
function short(name, room = 36) {
  return name.length > room ? `${name.slice(0, room - 1)}…` : name;
}

function button(label, act, attributes = {}) {
  const made = el("button", { type: "button", ...attributes }, label);
  made.addEventListener("click", act);
  return made;
}

/** Return a select with its label; `act` is called with the key chosen. */
function chooser(label, options, chosen, act) {
  const list = el("select", {}, options.map(([key, text]) => el("option", { value: key, selected: key === chosen }, text)));
  list.addEventListener("change", () => act(list.value));
  return el("label", { class: "chooser" }, el("span", {}, label), list);
}

/** Return a figure; its width is "wide", "third" or, by default, half of the room. */
function figure(title, body, caption, { width = "", tools = null, name = null } = {}) {
  return el(
    "figure",
    { class: `figure ${width}`.trim(), "data-figure": name },
    el("div", { class: "figure-head" }, el("h3", {}, title), tools),
    body,
    caption ? el("figcaption", {}, el("p", {}, caption)) : null,
  );
}
