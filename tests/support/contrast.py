"""Contrast of a page's texts on their grounds, as WCAG 2 defines it, measured in the browser."""

SCRIPT = """
const channel = (v) => (v /= 255, v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
const light = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
const parts = (text) => (text.match(/[\\d.]+/g) || [0, 0, 0, 0]).map(Number);
const ground = (node) => {
  for (let at = node; at; at = at.parentElement) {
    const colour = parts(getComputedStyle(at).backgroundColor);
    if (colour.length === 3 || colour[3] === 1) return colour;
  }
  return [255, 255, 255];
};
const low = [];
for (const node of document.querySelectorAll("body *")) {
  const words = [...node.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
  if (!words || node.closest("script, noscript, svg.map") || !node.getClientRects().length) continue;
  const style = getComputedStyle(node), inSvg = node.namespaceURI.endsWith("svg");
  const [a, b] = [light(parts(inSvg ? style.fill : style.color)), light(ground(node))].sort((x, y) => y - x);
  const ratio = (a + 0.05) / (b + 0.05);
  if (ratio < 4.5) low.push(`${node.tagName} "${node.textContent.trim().slice(0, 30)}" ${ratio.toFixed(2)}`);
}
return low;
"""
"""Returns the elements with text whose contrast is below 4.5, in words."""
