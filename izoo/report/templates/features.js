"use strict";
{
  const SIZE = { width: 360, height: 250, left: 46, right: 12, top: 10, bottom: 42 };

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

  const element = (name, attributes, text) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
    if (text !== undefined) made.textContent = text;
    return made;
  };

  /** Round numbers between two ends, some four of them. */
  const ticks = (low, high) => {
    const rough = (high - low) / 4, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find(factor => factor * power >= rough);
    const found = [];
    for (let tick = Math.ceil(low / step) * step; tick <= high + 1e-9 * step; tick += step) found.push(Number(tick.toPrecision(6)));
    return found;
  };

  const ends = values => {
    const low = Math.min(...values), high = Math.max(...values), room = 0.05 * (high - low || 1);
    return [low - room, high + room];
  };

  /** CO2 saved in every context against one of its features, as SVG; null where the feature does not vary. */
  const featureFigure = (content, policy, feature, label) => {
    const rows = content.rows, { key, label: measure } = content.measure, points = [];
    rows.policy.forEach((name, k) => {
      const x = rows[feature][k], y = rows[key][k];
      if (name === policy && x !== null && y !== null) points.push([x, Math.max(-100, Math.min(100, y)), rows.context[k]]);
    });
    if (new Set(points.map(point => point[0])).size < 2) return null;
    const { width, height, left, right, top, bottom } = SIZE;
    const [x0, x1] = ends(points.map(p => p[0])), [y0, y1] = ends([0, ...points.map(p => p[1])]);
    const across = x => left + (x - x0) / (x1 - x0) * (width - left - right);
    const up = y => height - bottom - (y - y0) / (y1 - y0) * (height - top - bottom);
    const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, "font-size": 11 });
    for (const tick of ticks(y0, y1)) {
      svg.append(element("line", { x1: left, x2: width - right, y1: up(tick), y2: up(tick), stroke: tick === 0 ? "var(--quiet)" : "var(--grid)" }));
      svg.append(element("text", { x: left - 5, y: up(tick) + 4, "text-anchor": "end" }, tick));
    }
    for (const tick of ticks(x0, x1)) svg.append(element("text", { x: across(tick), y: height - bottom + 14, "text-anchor": "middle" }, tick));
    svg.append(element("text", { x: (left + width - right) / 2, y: height - 8, "text-anchor": "middle" }, label));
    svg.append(element("text", { transform: `translate(11 ${(top + height - bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, measure));
    const many = points.length > 300, colour = content.colours[policy];
    for (const [x, y, name] of points) {
      const dot = element("circle", { cx: across(x), cy: up(y), r: many ? 2 : 3.5, fill: colour, opacity: many ? 0.4 : 0.75 });
      dot.append(element("title", {}, `${name}: ${y.toFixed(1)} %`));
      svg.append(dot);
    }
    const line = trend(points).map(([x, y]) => `${across(x)},${up(y)}`).join(" ");
    svg.append(element("polyline", { points: line, fill: "none", stroke: "var(--ink)", "stroke-width": 2 }));
    return { svg, alt: `${measure} of ${policy} against ${label}: ${points.length} contexts.` };
  };

  report.ready.then(content => {
    const box = byId("where-policies");
    if (!box) return;
    const policies = Object.keys(content.colours);
    choices(box, policies, index => {
      const plots = Object.entries(content.features).map(([feature, label]) => featureFigure(content, policies[index], feature, label));
      byId("where-plots").replaceChildren(...plots.filter(Boolean).map(({ svg, alt }) => {
        const frame = document.createElement("figure"), place = document.createElement("div");
        frame.className = "chart";
        place.className = "plot";
        place.setAttribute("role", "img");
        place.setAttribute("aria-label", alt);
        place.append(svg);
        frame.append(place);
        return frame;
      }));
    });
  });
}
