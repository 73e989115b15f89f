// The bundle: each part acts on the elements of its own page, if present.
import "./motion-page.js";
import "./page.js";
