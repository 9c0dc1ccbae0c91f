"use strict";
// One choice of methods for all plots: by the buttons beside the navigation or by any legend.
(() => {
  const bar = document.querySelector(".methods");
  const buttons = new Map([...bar.querySelectorAll("button")].map((b) => [b.dataset.method, b]));
  const banded = bar.querySelector("select");
  const hidden = new Set();
  const plots = new Set();

  function visible({ method, band }) {
    if (hidden.has(method)) return band ? false : "legendonly";
    return !band || method === banded.value;
  }

  function apply(div) {
    const indices = [], wanted = [];
    div.data.forEach((trace, i) => {
      if (!trace.meta) return;
      const now = visible(trace.meta);
      if ((trace.visible ?? true) === now) return;
      indices.push(i);
      wanted.push(now);
    });
    if (indices.length) Plotly.restyle(div, { visible: wanted }, indices);
  }

  function choose(change) {
    change();
    buttons.forEach((button, method) => button.setAttribute("aria-pressed", String(!hidden.has(method))));
    plots.forEach(apply);
  }

  function toggle(method) {
    choose(() => { if (!hidden.delete(method)) hidden.add(method); });
  }

  // only this method, or all again
  function isolate(method) {
    const others = [...buttons.keys()].filter((m) => m !== method);
    const alone = !hidden.has(method) && others.every((m) => hidden.has(m));
    choose(() => {
      hidden.clear();
      if (!alone) others.forEach((m) => hidden.add(m));
    });
  }

  function methodOf(div, event) {
    return div.data[event.curveNumber].meta?.method;
  }

  buttons.forEach((button, method) => {
    button.addEventListener("click", () => toggle(method));
    button.addEventListener("dblclick", () => isolate(method));
  });
  banded.addEventListener("change", () => plots.forEach(apply));
  document.addEventListener("drawn", ({ detail: div }) => {
    plots.add(div);
    apply(div);
    for (const [name, act] of [["plotly_legendclick", toggle], ["plotly_legenddoubleclick", isolate]]) {
      div.on(name, (event) => {
        const method = methodOf(div, event);
        if (method === undefined) return true;
        act(method);
        return false;
      });
    }
  });
})();
