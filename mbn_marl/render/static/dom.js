// Making elements.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

/** An HTML element with attributes and children (elements or text). */
function html(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

/** The same for SVG. */
function svg(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

/** A number for people: thousands apart, a proper minus sign. */
function shown(number) {
  const digits = Math.abs(number) >= 1000 || Number.isInteger(number) ? 0 : 2;
  return number
    .toLocaleString("en-US", { maximumFractionDigits: digits })
    .replace("-", "\u2212");
}

/** A number in few letters, such as 158.8K. */
function brief(number) {
  return number
    .toLocaleString("en-US", { notation: "compact", maximumSignificantDigits: 4 })
    .replace("-", "\u2212");
}
