"use strict";
// Timelines: zoom, drag, tooltips and keys over SVG that is whole without any of this.
document.documentElement.classList.add("with-js");
const tip = document.getElementById("tip");
const LEAST = 1e-3; // the closest look: this share of the whole

function show(text, x, y) {
  tip.textContent = text;
  tip.hidden = false;
  const box = tip.getBoundingClientRect();
  const left = Math.max(4, Math.min(x + 12, innerWidth - box.width - 4));
  const top = y + 18 + box.height > innerHeight ? y - box.height - 12 : y + 18;
  tip.style.transform = `translate(${left}px, ${Math.max(4, top)}px)`;
}

function hide() { tip.hidden = true; }

function round(span) { // the step between ticks: 1, 2 or 5 times a power of ten
  const power = 10 ** Math.floor(Math.log10(span / 6));
  return [1, 2, 5, 10].map((n) => n * power).find((step) => span / step <= 6.0001);
}

for (const panel of document.querySelectorAll(".panel")) {
  const view = panel.querySelector(".view");
  const svg = view.querySelector("svg");
  const axis = view.querySelector(".axis");
  const end = Number(panel.dataset.end);
  const height = svg.viewBox.baseVal.height;
  const lanes = [...svg.querySelectorAll("g.lane:not(.tokens)")].map((lane) => [...lane.querySelectorAll("rect")]);
  let from = 0, span = end, picked = null, drag = null;

  for (const part of svg.querySelectorAll("title")) { // one tooltip, not two
    part.parentNode.dataset.text = part.textContent;
    part.remove();
  }

  function draw() {
    svg.setAttribute("viewBox", `${from} 0 ${span} ${height}`);
    const step = round(span), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    axis.replaceChildren();
    for (let place = Math.ceil(from / step - 1e-9); place * step < from + 0.96 * span; place++) {
      const mark = document.createElement("span");
      mark.style.left = `${(100 * (place * step - from)) / span}%`;
      mark.textContent = (place * step).toFixed(digits);
      axis.append(mark);
    }
  }

  function look(start, width) {
    span = Math.min(end, Math.max(end * LEAST, width));
    from = Math.min(end - span, Math.max(0, start));
    draw();
  }

  function zoom(factor, at = from + span / 2) { look(at - (at - from) * factor, span * factor); }

  function pick(bar) {
    picked?.classList.remove("picked");
    picked = bar;
    if (!bar) return hide();
    bar.classList.add("picked");
    const x = Number(bar.getAttribute("x")), width = Number(bar.getAttribute("width"));
    if (x < from || x + width > from + span) look(x + width / 2 - span / 2, span);
    const box = bar.getBoundingClientRect();
    show(bar.dataset.text, box.left, box.bottom);
  }

  function step(along, across) { // to the next bar of the lane, or to the bar of another lane that is nearest in time
    const lane = lanes.findIndex((bars) => bars.includes(picked));
    if (lane < 0) return pick(lanes.flat()[0] ?? null);
    const bars = lanes[lane + across];
    if (!bars?.length) return;
    if (along) return pick(bars[bars.indexOf(picked) + along] ?? picked);
    const near = (bar) => Math.abs(bar.getAttribute("x") - picked.getAttribute("x"));
    pick(bars.reduce((best, bar) => (near(bar) < near(best) ? bar : best)));
  }

  const keys = {
    "+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), 0: () => look(0, end), Escape: () => pick(null),
    ArrowRight: (far) => (far ? look(from + span / 4, span) : step(1, 0)),
    ArrowLeft: (far) => (far ? look(from - span / 4, span) : step(-1, 0)),
    ArrowDown: () => step(0, 1), ArrowUp: () => step(0, -1),
  };
  view.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key](event.shiftKey);
  });
  view.addEventListener("blur", () => pick(null));

  const at = (event) => {
    const box = svg.getBoundingClientRect();
    return from + (span * (event.clientX - box.left)) / box.width;
  };
  svg.addEventListener("wheel", (event) => {
    if (document.activeElement !== view && !event.ctrlKey) return; // else the page could not be scrolled
    event.preventDefault();
    zoom(event.deltaY > 0 ? 1.25 : 0.8, at(event));
  }, { passive: false });
  svg.addEventListener("pointerdown", (event) => {
    drag = { x: event.clientX, from };
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (drag) look(drag.from - (span * (event.clientX - drag.x)) / svg.clientWidth, span);
    const hit = document.elementFromPoint(event.clientX, event.clientY);
    if (hit?.dataset?.text && svg.contains(hit)) show(hit.dataset.text, event.clientX, event.clientY);
    else hide();
  });
  for (const over of ["pointerup", "pointercancel"]) svg.addEventListener(over, () => { drag = null; });
  svg.addEventListener("pointerleave", (event) => { if (event.pointerType !== "touch") hide(); });

  const buttons = document.createElement("div");
  buttons.className = "zoom";
  for (const [text, name, act] of [["+", "zoom in", keys["+"]], ["\u2212", "zoom out", keys["-"]], ["all", "show all", keys[0]]]) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.setAttribute("aria-label", `${name}: ${panel.querySelector("figcaption b").textContent}`);
    button.addEventListener("click", act);
    buttons.append(button);
  }
  panel.append(buttons);
  svg.classList.add("zoomable");
  draw();
}

// What is folded away is printed all the same.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => { part.open = true; }));
