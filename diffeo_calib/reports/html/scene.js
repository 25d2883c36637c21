"use strict";
// Draws every scene of the page: measured places, and errors as arrows that are all enlarged by one factor.
for (const box of document.querySelectorAll(".scene")) {
  const { points, errors } = JSON.parse(box.querySelector("script").textContent);
  const canvas = box.querySelector("canvas");
  const buttons = [...box.querySelectorAll("button")];
  const low = [0, 1, 2].map((k) => Math.min(...points.map((p) => p[k])));
  const high = [0, 1, 2].map((k) => Math.max(...points.map((p) => p[k])));
  const centre = low.map((v, k) => (v + high[k]) / 2);
  const size = Math.max(...low.map((v, k) => high[k] - v), 1e-6);
  const length = (v) => Math.hypot(...v);
  // The stage before the last sets the scale, by its 95th percentile: one outlier must not shrink all arrows.
  const stages = Object.keys(errors);
  const reference = stages[Math.max(stages.length - 2, 0)];
  const usual = (stage) => errors[stage].map(length).sort((a, b) => a - b)[Math.floor(0.95 * (points.length - 1))];
  const longest = Math.max(usual(reference), 1e-9);
  const factor = (0.13 * size) / longest;
  const view = { turn: -0.7, tilt: 0.42, zoom: 1, stage: reference };

  // Blue over green to yellow in light pages, the same order in dark ones: lightness grows or falls monotonically.
  const stops = [[68, 57, 138], [45, 112, 142], [31, 158, 120], [139, 190, 50], [236, 170, 20]];
  const colour = (share) => {
    const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
    const k = Math.min(Math.floor(at), stops.length - 2);
    return `rgb(${stops[k].map((v, i) => Math.round(v + (at - k) * (stops[k + 1][i] - v))).join()})`;
  };

  const project = (p, width, height) => {
    const [x, y, z] = p.map((v, k) => (v - centre[k]) / size);
    const [s, c, S, C] = [Math.sin(view.turn), Math.cos(view.turn), Math.sin(view.tilt), Math.cos(view.tilt)];
    const [right, away] = [c * x - s * y, s * x + c * y];
    const depth = C * away - S * z;
    const scale = (0.5 * view.zoom * Math.min(width, 1.35 * height)) / (1 + 0.25 * depth);
    return [width / 2 + scale * right, height / 2 - scale * (C * z + S * away), depth];
  };

  const draw = () => {
    const { width, height } = canvas.getBoundingClientRect();
    const sharp = Math.max(window.devicePixelRatio || 1, 1);
    canvas.width = Math.round(width * sharp);
    canvas.height = Math.round(height * sharp);
    const pen = canvas.getContext("2d");
    pen.scale(sharp, sharp);
    const style = getComputedStyle(document.documentElement);
    const line = (a, b, stroke, thick) => {
      pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]);
      pen.strokeStyle = stroke; pen.lineWidth = thick; pen.stroke();
    };
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((n) => [0, 1, 2].map((k) => ((n >> k) & 1 ? high[k] : low[k])));
    const edges = corners.flatMap((_, n) => [0, 1, 2].filter((k) => !((n >> k) & 1)).map((k) => [n, n | (1 << k), k]));
    pen.font = "12px system-ui, sans-serif";
    for (const [n, other, k] of edges) {
      const [a, b] = [corners[n], corners[other]].map((p) => project(p, width, height));
      line(a, b, style.getPropertyValue("--grid"), 1);
      if (n === 0) {
        pen.fillStyle = style.getPropertyValue("--faint");
        pen.fillText(`${"xyz"[k]} ${high[k].toFixed(2)} m`, b[0] + 4, b[1] - 4);
      }
    }
    points
      .map((p, n) => ({ from: project(p, width, height), error: errors[view.stage][n], p }))
      .sort((a, b) => b.from[2] - a.from[2])
      .forEach(({ from, error, p }) => {
        const stroke = colour(length(error) / longest);
        const tip = project(p.map((v, k) => v + factor * error[k]), width, height);
        line(from, tip, stroke, 1.6);
        const [dx, dy] = [tip[0] - from[0], tip[1] - from[1]];
        const far = Math.hypot(dx, dy);
        if (far > 6) {
          pen.beginPath(); pen.moveTo(tip[0], tip[1]);
          for (const side of [-1, 1]) {
            pen.lineTo(tip[0] - (5 * dx + side * 2.5 * dy) / far, tip[1] - (5 * dy - side * 2.5 * dx) / far);
          }
          pen.fillStyle = stroke; pen.fill();
        }
        pen.beginPath(); pen.arc(from[0], from[1], 2, 0, 7); pen.fillStyle = stroke; pen.fill();
      });
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.stage === view.stage));
    const rms = Math.sqrt(errors[view.stage].reduce((sum, e) => sum + length(e) ** 2, 0) / points.length);
    box.querySelector(".scale").textContent =
      `${view.stage}: ${(1e3 * rms).toPrecision(3)} mm RMS; arrows enlarged ${Number(factor.toPrecision(2))} times, ` +
      `colours from 0 (blue) to ${(1e3 * longest).toPrecision(2)} mm and more (yellow), the same in every view.`;
  };

  const turn = (by, up) => {
    view.turn += by;
    view.tilt = Math.min(Math.max(view.tilt + up, -1.5), 1.5);
    draw();
  };
  const zoom = (by) => { view.zoom = Math.min(Math.max(view.zoom * by, 0.3), 8); draw(); };
  let held = null;
  canvas.addEventListener("pointerdown", (event) => {
    held = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    turn((event.clientX - held[0]) / 150, (event.clientY - held[1]) / 150);
    held = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { held = null; });
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return; // the page scrolls unless the reader works here
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 600));
  }, { passive: false });
  const keys = {
    ArrowLeft: () => turn(-0.12, 0), ArrowRight: () => turn(0.12, 0), ArrowUp: () => turn(0, 0.12),
    ArrowDown: () => turn(0, -0.12), "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15),
  };
  canvas.addEventListener("keydown", (event) => {
    if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
  });
  for (const button of buttons) button.addEventListener("click", () => { view.stage = button.dataset.stage; draw(); });
  for (const change of ["(prefers-color-scheme: dark)", "print"]) window.matchMedia(change).addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas);
  draw();
}
