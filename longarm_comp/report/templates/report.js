"use strict";
// The page is complete without this: it adds the turning scene, sorting and filtering.
(() => {
  const byId = (id) => document.getElementById(id);

  function turningScene() {
    const data = byId("scene-data");
    if (!data) return;
    const { arms, rows, tips, stages } = JSON.parse(data.textContent);
    const plot = byId("plot");
    const pen = plot.getContext("2d");
    byId("turning").hidden = false;
    const points = [...arms.flat(), ...tips];
    const ends = [0, 1, 2].map((k) => points.map((p) => p[k]))
      .map((values) => [Math.min(...values), Math.max(...values)]);
    const middle = ends.map(([low, high]) => (low + high) / 2);
    const far = points.map((p) => Math.hypot(...p.map((value, k) => value - middle[k])));
    const scale = 0.45 * plot.height / Math.max(...far, 1e-3); // whichever way it is turned
    pen.lineJoin = "round";
    let [turn, tilt] = [-0.9, 0.4];
    const seen = (p) => {
      const [x, y, z] = p.map((value, k) => value - middle[k]);
      const [c, s] = [Math.cos(turn), Math.sin(turn)];
      const up = Math.cos(tilt) * z + Math.sin(tilt) * (s * x + c * y);
      return [plot.width / 2 + scale * (c * x - s * y), plot.height / 2 - scale * up];
    };
    const line = (corners, color, width, dots) => {
      [pen.strokeStyle, pen.fillStyle, pen.lineWidth] = [color, color, width];
      pen.beginPath();
      corners.forEach((at) => pen.lineTo(...at));
      pen.stroke();
      for (const [x, y] of dots) pen.fillRect(x - 4, y - 4, 8, 8);
    };
    const chosen = () => stages[document.querySelector("input[name=stage]:checked").value];
    const draw = () => {
      const { errors, times, color } = chosen();
      pen.clearRect(0, 0, plot.width, plot.height);
      for (const arm of arms.map((corners) => corners.map(seen))) line(arm, "#8a8a8a", 8, arm);
      const axes = [["#a33", "x"], ["#363", "y"], ["#33a", "z"]];
      axes.forEach(([ink, name], k) => {
        const along = [0, 0, 0].map((_, j) => middle[j] + (j === k ? 60 / scale : 0));
        const [from, to] = [seen(middle), seen(along)].map(([x, y]) =>
          [x - plot.width / 2 + 90, y + plot.height / 2 - 90]);
        line([from, to], ink, 3, []);
        pen.font = "28px sans-serif";
        pen.fillText(name, ...to);
      });
      tips.forEach((tip, k) => {
        const stop = seen(tip.map((value, j) => value + times * errors[k][j]));
        line([seen(tip), stop], color, 4, [seen(tip)]);
      });
      byId("times").textContent = `arrows × ${times}`;
    };
    plot.addEventListener("pointerdown", (event) => plot.setPointerCapture(event.pointerId));
    plot.addEventListener("pointermove", (event) => {
      if (event.buttons) {
        turn += event.movementX / 150;
        tilt += event.movementY / 150;
        draw();
        return;
      }
      const zoom = plot.width / plot.clientWidth;
      const off = tips.map(seen).map(([x, y]) =>
        Math.hypot(x / zoom - event.offsetX, y / zoom - event.offsetY));
      const near = off.indexOf(Math.min(...off));
      const mm = chosen().errors[near].map((value) => (1e3 * value).toFixed(2)).join(", ");
      plot.title = off[near] < 8 ? `row ${rows[near]}: (${mm}) mm` : "";
    });
    byId("turning").addEventListener("change", draw);
    draw();
  }

  function candidateTables() {
    const table = byId("tried");
    if (!table) return;
    const heads = [...table.querySelectorAll("th[data-key]")];
    const keys = heads.map((head) => head.dataset.key);
    const rows = [...table.tBodies[0].rows];
    let sorted = { key: "score", down: true };

    const value = (row, key) => {
      if (key === "score") return row.dataset.score === "" ? null : Number(row.dataset.score);
      return row.cells[keys.indexOf(key)].textContent;
    };
    const order = (a, b) => {
      const [left, right] = [value(a, sorted.key), value(b, sorted.key)];
      if (left === null || right === null) return (left === null) - (right === null);
      const rise = typeof left === "number" ? left - right : left.localeCompare(right, "en");
      return sorted.down ? -rise : rise;
    };
    const fits = (row) => {
      const words = byId("words").value.toLowerCase().split(/\s+/);
      const state = byId("state").value;
      const text = row.textContent.toLowerCase();
      return (!state || row.dataset.state === state) && words.every((word) => text.includes(word));
    };
    const show = (all = false) => {
      const kept = rows.filter((row) => all || fits(row)).sort(order);
      table.tBodies[0].replaceChildren(...kept);
      const direction = sorted.down ? "descending" : "ascending";
      heads.forEach((head) => {
        head.setAttribute("aria-sort", head.dataset.key === sorted.key ? direction : "none");
      });
      byId("count").textContent = `${kept.length} of ${rows.length}`;
    };
    heads.forEach((head) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = head.textContent;
      button.addEventListener("click", () => {
        const key = head.dataset.key;
        sorted = { key, down: sorted.key === key ? !sorted.down : key === "score" };
        show();
      });
      head.replaceChildren(button);
    });
    byId("words").addEventListener("input", () => show());
    byId("state").addEventListener("change", () => show());
    addEventListener("beforeprint", () => show(true));
    addEventListener("afterprint", () => show());
    byId("filter").hidden = false;
    show();
  }

  candidateTables();
  turningScene();
  // On paper nothing is folded away.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("details:not([open])")];
    folded.forEach((entry) => { entry.open = true; });
  });
  addEventListener("afterprint", () => { folded.forEach((entry) => { entry.open = false; }); });
})();
