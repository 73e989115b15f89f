// The bundle: every page takes from it what its elements ask for.
import "./motion-page.js";
import "./page.js";
