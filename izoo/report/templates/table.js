"use strict";
if (byId("rows")) report.ready.then(content => {
  const PAGE = 50, { columns, rows } = content, body = byId("rows").tBodies[0];
  const count = rows.policy.length;
  let order = Array.from({ length: count }, (_, k) => k), shown = order, page = 0;

  const text = (column, k) => {
    const value = rows[column.key][k];
    return value === null ? "" : column.digits === null ? String(value) : value.toFixed(column.digits).replace(/^-(0(\.0*)?)$/, "$1");
  };

  const render = () => {
    const pages = Math.max(1, Math.ceil(shown.length / PAGE));
    page = Math.min(page, pages - 1);
    body.replaceChildren(...shown.slice(page * PAGE, (page + 1) * PAGE).map(k => {
      const line = document.createElement("tr");
      columns.forEach((column, c) => {
        const cell = document.createElement(c ? "td" : "th");
        if (!c) cell.scope = "row";
        cell.textContent = text(column, k);
        if (column.digits === null) cell.className = "text";
        else if (rows[column.key][k] < 0) cell.className = "minus";
        cell.classList.toggle("more", column.more);
        line.append(cell);
      });
      return line;
    }));
    byId("filter-count").textContent = `${shown.length} of ${count} rows`;
    byId("page-number").textContent = `page ${page + 1} of ${pages}`;
    byId("previous").disabled = page === 0;
    byId("following").disabled = page >= pages - 1;
  };

  /** "co2_saved<0" becomes a test of the first column whose key or label begins with that word. */
  const condition = word => {
    const found = /^([a-z][a-z0-9_]*)(<=|>=|<|>|=)(-?[\d.]+)$/i.exec(word);
    if (!found) return null;
    const [, name, sign, bound] = found;
    const column = columns.find(c => c.digits !== null && (c.key.startsWith(name.toLowerCase()) || c.label.startsWith(name.toLowerCase())));
    if (!column) return null;
    const tests = { "<": (a, b) => a < b, ">": (a, b) => a > b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b, "=": (a, b) => a === b };
    return k => rows[column.key][k] !== null && tests[sign](rows[column.key][k], Number(bound));
  };

  const filter = () => {
    const policy = byId("filter-policy").value;
    const words = byId("filter-text").value.trim().split(/\s+/).filter(Boolean);
    const tests = words.map(word => condition(word)
      ?? (k => `${rows.context[k]} ${rows.policy[k]} ${rows.test[k]}`.toLowerCase().includes(word.toLowerCase())));
    shown = order.filter(k => (!policy || rows.policy[k] === policy) && tests.every(test => test(k)));
    page = 0;
    render();
  };

  const sort = (column, down) => {
    const values = rows[column.key];
    const compare = column.digits === null ? (a, b) => a.localeCompare(b, undefined, { numeric: true }) : (a, b) => a - b;
    order = [...order].sort((a, b) => {
      const [x, y] = [values[a], values[b]];
      if (x === null || y === null) return (x === null) - (y === null);
      return (down ? -1 : 1) * compare(x, y);
    });
    filter();
  };

  const heads = columns.map(column => {
    const head = document.createElement("th"), button = document.createElement("button");
    head.scope = "col";
    if (column.digits === null) head.className = "text";
    head.classList.toggle("more", column.more);
    button.type = "button";
    button.textContent = column.label;
    if (column.meaning) button.title = column.meaning;
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      sort(column, down);
    });
    head.append(button);
    return head;
  });
  byId("rows").tHead.rows[0].replaceChildren(...heads);
  const option = (value, label) => Object.assign(document.createElement("option"), { value, textContent: label });
  byId("filter-policy").replaceChildren(option("", "all"), ...[...new Set(rows.policy)].map(name => option(name, name)));
  byId("filter-policy").addEventListener("change", filter);
  byId("filter-text").addEventListener("input", filter);
  byId("every-figure").addEventListener("change", event => byId("rows").classList.toggle("every", event.target.checked));
  byId("previous").addEventListener("click", () => { page -= 1; render(); });
  byId("following").addEventListener("click", () => { page += 1; render(); });
  filter();
});
