"use strict";
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const touch = matchMedia("(pointer: coarse)").matches;
  const narrow = matchMedia("(max-width: 760px)");
  const timePlots = new Map(); // plot over time -> the range it shows, "moving" while it changes
  const inView = new Set();
  let shared = null; // the range in time chosen last, as plotly takes it
  let charts = [];

  async function unpack(id) {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }

  function template() {
    const [ink, soft, grid, sheet] = dark.matches
      ? ["#e2e7ee", "#9aa6b5", "#2c3541", "#1a2029"]
      : ["#1d2733", "#5a6675", "#e4e8ee", "#ffffff"];
    const axis = {
      gridcolor: grid, linecolor: grid, zerolinecolor: grid, zerolinewidth: 1, automargin: true,
      tickfont: { color: soft }, title: { font: { color: soft, size: 12 }, standoff: 6 },
    };
    return {
      layout: {
        paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", barmode: "overlay",
        font: { color: ink, size: 12, family: getComputedStyle(document.body).fontFamily },
        xaxis: axis, yaxis: axis,
        polar: { bgcolor: "rgba(0,0,0,0)", radialaxis: axis, angularaxis: axis },
        hoverlabel: { bgcolor: sheet, bordercolor: grid, font: { color: ink } },
        legend: { orientation: "h", x: 0, xanchor: "left", y: 1.0, yanchor: "bottom", bgcolor: "rgba(0,0,0,0)" },
        modebar: { bgcolor: "rgba(0,0,0,0)", color: soft, activecolor: ink },
      },
    };
  }

  function height(chart, div) {
    if (!narrow.matches) return chart.height;
    return chart.time ? Math.round(chart.height * 0.86) : Math.min(chart.height, div.clientWidth + 60);
  }

  // Plots in view follow a zoom in time at once, the others when they come into view.
  function follow(div, change) {
    if (timePlots.get(div) === "moving") return;
    const range = change["xaxis.range"] || [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    const reset = change["xaxis.autorange"] === true;
    if (!reset && (range[0] === undefined || range[1] === undefined)) return;
    shared = reset ? { "xaxis.autorange": true } : { "xaxis.range": [range[0], range[1]] };
    timePlots.set(div, shared);
    inView.forEach(catchUp);
  }

  async function catchUp(div) {
    if (shared === null || timePlots.get(div) === shared || timePlots.get(div) === "moving") return;
    const target = shared;
    timePlots.set(div, "moving");
    await Plotly.relayout(div, target);
    timePlots.set(div, target);
    catchUp(div);
  }

  const watchPlots = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (isIntersecting) { inView.add(target); catchUp(target); } else inView.delete(target);
    }
  });

  function addTouchZoom(div) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "touch-zoom";
    button.textContent = "Zoom";
    button.setAttribute("aria-pressed", "false");
    button.addEventListener("click", () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", String(on));
      const update = { dragmode: on ? "zoom" : false };
      Plotly.relayout(div, update);
    });
    div.parentElement.append(button);
  }

  async function draw(div) {
    if (div.dataset.drawn) return;
    div.dataset.drawn = "1";
    const chart = charts[Number(div.dataset.chart)];
    div.style.height = height(chart, div) + "px";
    const margin = narrow.matches ? { l: 46, r: 8, t: 24, b: 36 } : { l: 58, r: 14, t: 26, b: 40 };
    if (chart.layout.polar) Object.assign(margin, { l: 34, r: 34 });
    const base = { template: template(), margin, autosize: true, dragmode: touch ? false : "zoom" };
    const config = {
      responsive: true, displaylogo: false, displayModeBar: touch ? false : "hover",
      modeBarButtons: chart.layout.polar ? [["toImage"]] : [["toImage", "zoom2d", "pan2d", "resetScale2d"]],
    };
    await Plotly.newPlot(div, chart.data, { ...base, ...chart.layout }, config);
    if (touch && !chart.layout.polar) addTouchZoom(div);
    if (chart.time) {
      timePlots.set(div, null);
      div.on("plotly_relayout", (change) => follow(div, change));
      watchPlots.observe(div);
    }
    document.dispatchEvent(new CustomEvent("drawn", { detail: div }));
  }

  async function drawAll(root) {
    for (const div of root.querySelectorAll(".plot")) {
      if (div.closest("details:not([open])")) continue;
      await draw(div);
      // lets the page scroll and answer between two plots
      await new Promise((resume) => setTimeout(resume, 0));
    }
  }

  function markSection() {
    const links = new Map([...document.querySelectorAll("nav a")].map((a) => [a.hash.slice(1), a]));
    const watch = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        if (!entry.isIntersecting) continue;
        links.forEach((a) => a.classList.remove("here"));
        const link = links.get(entry.target.id);
        link.classList.add("here");
        const bar = link.parentElement;
        bar.scrollTo({ left: link.offsetLeft - bar.clientWidth / 2 + link.clientWidth / 2 });
      }
    }, { rootMargin: "-30% 0px -65% 0px" });
    document.querySelectorAll("section").forEach((section) => watch.observe(section));
  }

  function recolour() {
    for (const div of document.querySelectorAll(".plot[data-drawn]")) Plotly.relayout(div, { template: template() });
  }

  function refuse() {
    for (const div of document.querySelectorAll(".plot")) {
      div.style.height = "auto";
      div.textContent = "This browser is too old for the plots: Chromium 80, Firefox 113, Safari 16.4 or newer draws them.";
    }
  }

  async function start() {
    markSection();
    if (typeof DecompressionStream === "undefined") return refuse();
    const script = document.createElement("script");
    script.textContent = await unpack("packed-plotly");
    document.head.append(script);
    charts = JSON.parse(await unpack("packed-charts"));
    document.querySelectorAll("details").forEach((d) => d.addEventListener("toggle", () => { if (d.open) drawAll(d); }));
    dark.addEventListener("change", recolour);
    await drawAll(document);
    document.documentElement.dataset.ready = "1";
  }

  start();
})();
