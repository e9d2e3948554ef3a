"use strict";
{
  let plotly = null;
  const drawn = new Map();

  /** plotly.js, unpacked when the first figure comes into view. */
  const library = () => plotly ??= unpack("plotly-pack").then(text => {
    const script = document.createElement("script");
    script.textContent = text;
    document.head.append(script);
    return window.Plotly;
  });

  const dress = layout => {
    const touch = matchMedia("(pointer: coarse)").matches;
    const axis = own => ({ gridcolor: colourOf("--grid"), zerolinecolor: colourOf("--quiet"), linecolor: colourOf("--line"), fixedrange: touch, ...own });
    return {
      margin: { l: 52, r: 14, t: 14, b: 44 },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0, xanchor: "left" },
      hoverlabel: { align: "left" },
      ...layout,
      autosize: true,
      dragmode: touch ? false : "zoom",
      font: { family: "system-ui, sans-serif", size: 12, color: colourOf("--ink") },
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      xaxis: axis(layout.xaxis), yaxis: axis(layout.yaxis),
    };
  };

  const draw = async (element, specification) => {
    drawn.set(element, specification);
    const Plotly = await library();
    await Plotly.react(element, structuredClone(specification.data), dress(specification.layout), { responsive: true, displayModeBar: false });
    element.dataset.drawn = "yes";
  };

  const watcher = new IntersectionObserver(entries => entries.filter(entry => entry.isIntersecting).forEach(entry => {
    watcher.unobserve(entry.target);
    const specification = entry.target.specification ?? report.content.figures[entry.target.dataset.figure];
    draw(entry.target, specification);
  }), { rootMargin: "300px" });

  themeListeners.push(() => drawn.forEach((specification, element) => draw(element, specification)));

  /** Means of groups of equal size, for a line through a cloud of points. */
  const trend = points => {
    const sorted = [...points].sort((a, b) => a[0] - b[0]);
    const groups = Math.min(sorted.length > 300 ? 10 : 5, Math.floor(sorted.length / 4));
    const mean = (part, k) => part.reduce((sum, point) => sum + point[k], 0) / part.length;
    return Array.from({ length: groups }, (_, g) => {
      const part = sorted.slice(Math.floor(g * sorted.length / groups), Math.floor((g + 1) * sorted.length / groups));
      return [mean(part, 0), mean(part, 1)];
    });
  };

  const escape = text => text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

  const featureFigure = (content, policy, feature, label) => {
    const rows = content.rows, { key, label: measure } = content.measure, points = [];
    rows.policy.forEach((name, k) => {
      const x = rows[feature][k], y = rows[key][k];
      if (name === policy && x !== null && y !== null) points.push([x, Math.max(-100, Math.min(100, y)), escape(rows.context[k])]);
    });
    if (new Set(points.map(point => point[0])).size < 2) return null;
    const many = points.length > 300, line = trend(points);
    return {
      data: [{
        type: "scatter", mode: "markers", name: policy, x: points.map(p => p[0]), y: points.map(p => p[1]), text: points.map(p => p[2]),
        marker: { color: content.colours[policy], size: many ? 4 : 7, opacity: many ? 0.4 : 0.75 }, hovertemplate: "%{text}<br>%{y:.1f} %<extra></extra>",
      }, { type: "scatter", mode: "lines", name: "mean", x: line.map(p => p[0]), y: line.map(p => p[1]), line: { color: colourOf("--ink"), width: 2 }, hoverinfo: "skip" }],
      layout: { showlegend: false, xaxis: { title: { text: label }, zeroline: false }, yaxis: { title: { text: measure }, zeroline: true } },
      alt: `${measure} of ${policy} against ${label}: ${points.length} contexts.`,
    };
  };

  report.ready.then(content => {
    document.querySelectorAll(".plot[data-figure]").forEach(element => watcher.observe(element));
    const box = byId("where-policies");
    if (!box) return;
    const policies = Object.keys(content.colours);
    choices(box, policies, index => {
      const plots = [];
      for (const [feature, label] of Object.entries(content.features)) {
        const specification = featureFigure(content, policies[index], feature, label);
        if (!specification) continue;
        const frame = document.createElement("figure"), element = document.createElement("div");
        frame.className = "chart";
        element.className = "plot";
        element.style.height = "250px";
        element.setAttribute("role", "img");
        element.setAttribute("aria-label", specification.alt);
        element.specification = specification;
        frame.append(element);
        plots.push(frame);
      }
      [...drawn.keys()].filter(element => byId("where-plots").contains(element)).forEach(element => drawn.delete(element));
      byId("where-plots").replaceChildren(...plots);
      plots.forEach(frame => watcher.observe(frame.firstChild));
    });
  });
}
