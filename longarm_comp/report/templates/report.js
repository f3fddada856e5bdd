"use strict";
// The page is complete without this: it adds the turning scene, sorting and filtering.
(() => {
  const byId = (id) => document.getElementById(id);

  function turningScene() {
    const data = byId("scene-data");
    if (!data || !window.Plotly) return;
    const gl = document.createElement("canvas").getContext("webgl");
    if (!gl) { byId("nogl").hidden = false; return; }
    const { data: traces, layout } = JSON.parse(data.textContent);
    const plot = byId("plot");
    byId("turning").hidden = false;
    const chosen = () => document.querySelector("input[name=stage]:checked").value;
    const fits = (trace) => !trace.meta || trace.meta.stage === chosen();
    const tell = () => {
      const trace = traces.find((entry) => entry.meta && fits(entry));
      if (trace) byId("times").textContent = `arrows × ${trace.meta.times}`;
    };
    // The wheel scrolls the page.
    const options = { responsive: true, displayModeBar: false, scrollZoom: false };
    Plotly.newPlot(plot, traces, layout, options).then(() => {
      document.documentElement.classList.add("alive");
    });
    byId("turning").addEventListener("change", () => {
      Plotly.restyle(plot, { visible: traces.map(fits) });
      tell();
    });
    tell();
  }

  function candidateTables() {
    const best = byId("best");
    if (!best) return;
    const bodies = [best, byId("rest")].filter(Boolean).map((table) => table.tBodies[0]);
    const heads = [...document.querySelectorAll(".candidates th[data-key]")];
    const keys = [...best.querySelectorAll("th[data-key]")].map((head) => head.dataset.key);
    const rows = bodies.flatMap((body) => [...body.rows]);
    const shown = bodies[0].rows.length;
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
      rows.forEach((row) => row.remove());
      kept.forEach((row, k) => bodies[k < shown || bodies.length === 1 ? 0 : 1].append(row));
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
