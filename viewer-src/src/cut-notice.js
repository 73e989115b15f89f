// What is being computed while a cut is prepared, or a step takes long: a notice on the 3-D view, with a bar where it is known how far it has come.
import { h } from "./elements.js";

const LONG_MS = 700; // a step that takes no longer is not told of

const PREPARING = "Cut (being prepared)"; // while kernels are compiled

export class CutNotice {
  /** @param {string[]} stages what is computed before a cut opens, in order */
  constructor(stages) {
    this.stages = stages;
    this.text = h("span", {});
    this.bar = h("progress", { max: stages.length, "aria-label": "Progress of the cut" });
    this.element = h("div", { class: "cut-notice", role: "status", hidden: true }, this.text, this.bar);
    this.asked = false; // whether a cut was asked for of which nothing has been heard
    this.cutting = false; // whether a cut is asked for or under way
  }

  /** A cut was asked for. */
  ask() {
    this.asked = true;
    this.#write("Cutting…");
  }

  /** The cut that was asked for came to something else: it opened, it was refused, or the connection is lost. */
  forget() {
    this.asked = false;
    this.#write("");
  }

  /** Follow a frame that came at a time, ms. */
  follow(frame, now) {
    if (!frame.underWay) this.since = now;
    if (frame.cutStage >= 0) this.asked = false;
    const text = frame.cutStage >= 0 ? `Cutting: ${this.stages[frame.cutStage]}…` : this.asked ? "Cutting…"
      : now - this.since > LONG_MS ? "Finding the balance of a step that takes long; the state before it is shown…" : "";
    this.#write(text, frame.cutStage);
  }

  /** Controls that conflict with a cut under way wait for it, and that of cuts also for their kernels, which the first run compiles. */
  permit(frame, controls) {
    controls.forEach((control) => {
      const cuts = control.dataset.mode === "cut";
      const waits = this.cutting || (frame.preparing && cuts);
      if (control.disabled !== waits) control.disabled = waits;
      const name = frame.preparing ? PREPARING : "Cut";
      if (cuts && control.textContent !== name) control.textContent = name;
    });
  }

  #write(text, stage = -1) {
    this.cutting = this.asked || stage >= 0;
    if (this.text.textContent !== text) this.text.textContent = text;
    this.element.hidden = text === "";
    if (stage >= 0) this.bar.value = stage + 0.5;
    else this.bar.removeAttribute("value"); // it moves, and says nothing
  }
}
