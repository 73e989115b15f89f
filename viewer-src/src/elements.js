// Helpers of all pages: creating elements, and explaining why there is no 3-D view.
import { canDraw } from "./view.js";

/** Make an element: h("p", {class: "note"}, "text", child). */
export function h(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value === true) element.setAttribute(key, "");
    else if (value !== false && value !== null) element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}

/** True if the browser can show the 3-D view; otherwise `root` shows the reason. */
export function canDrawOr(root) {
  const explain = (text) => root.replaceChildren(h("p", { class: "no-3d", role: "status" }, text));
  if (!canDraw()) {
    explain("This browser cannot draw in 3-D (WebGL 2 is missing or disabled). Everything else on this page is complete.");
    return false;
  }
  if (!("DecompressionStream" in window)) {
    explain("This browser is too old for the 3-D view (it needs DecompressionStream: any browser since 2023). Everything else on this page is complete.");
    return false;
  }
  return true;
}
