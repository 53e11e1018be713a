"use strict";
// Tables are sorted by their heads and saved as CSV; pictures are saved as they are.
(() => {
  const save = (name, url) => { const a = document.createElement("a"); a.href = url; a.download = name; a.click(); };
  const slug = (text) => text.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "").slice(0, 60) || "report";
  const study = slug(document.title.split(" – ")[0]);
  const button = (words, label, action) => {
    const b = document.createElement("button");
    b.type = "button"; b.textContent = words; b.setAttribute("aria-label", label); b.addEventListener("click", action);
    return b;
  };
  const tools = (...buttons) => { const d = document.createElement("div"); d.className = "tools"; d.append(...buttons); return d; };
  const before = (element) => {
    const heads = [...document.querySelectorAll("h1, h2, h3")].filter(
      (h) => !h.closest(".answer") && h.compareDocumentPosition(element) & Node.DOCUMENT_POSITION_FOLLOWING);
    return heads.length ? heads[heads.length - 1].textContent : "table";
  };
  // The number at the beginning of a cell, in SI units: "(1.2 ± 0.1) × 10⁻⁴ m" is 1.2e-4, "28.9 ± 0.1 mm" 0.0289.
  const digits = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  const numeric = (text) => {
    const plain = text.replace(/−/g, "-").replace(/,/g, "");
    const found = plain.match(/^[(\s]*([+-]?\d*\.?\d+(?:e[+-]?\d+)?)/i);
    if (!found) return null;
    const power = plain.match(/× 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/);
    const exponent = power ? Number([...power[1]].map((c) => (c === "⁻" ? "-" : digits.indexOf(c))).join("")) : 0;
    const unit = plain.match(/\s(GPa|MPa|kPa|mPa|[cmµn]m[²³]?|[kmµ]N|[kmµn]J)$/);
    const one = unit ? { G: 1e9, M: 1e6, k: 1e3, c: 1e-2, m: 1e-3, µ: 1e-6, n: 1e-9 }[unit[1][0]] : 1;
    const axes = unit && /[²³]$/.test(unit[1]) ? (unit[1].endsWith("²") ? 2 : 3) : 1;
    return Number(found[1]) * 10 ** exponent * one ** axes;
  };
  // A number and its unit stay on one line.
  const unbroken = /(\d) (?=(?:%|±|[GMk]?Pa|[cmµnk]?m[²³]?|[kmµ]?[NJ]|s)(?![\wµ]))|(±) (?=\d)/g;
  for (const element of document.querySelectorAll("p, li, dd, figcaption")) {
    for (const node of element.childNodes) {
      if (node.nodeType === Node.TEXT_NODE) node.data = node.data.replace(unbroken, "$1$2\u00a0");
    }
  }
  const sort = (table, column, head) => {
    const ascending = head.getAttribute("aria-sort") !== "ascending";
    for (const th of table.tHead.rows[0].cells) th.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    const body = table.tBodies[0], rows = [...body.rows];
    const keys = new Map(rows.map((row) => [row, row.cells[column] ? row.cells[column].textContent.trim() : ""]));
    const numbers = rows.every((row) => keys.get(row) === "" || keys.get(row) === "–" || numeric(keys.get(row)) !== null);
    const value = (row) => (numbers ? numeric(keys.get(row)) : keys.get(row));
    const last = (row) => keys.get(row) === "" || keys.get(row) === "–";  // stays below, either way
    rows.sort((a, b) => {
      if (last(a) || last(b)) return last(a) - last(b);
      const order = numbers ? value(a) - value(b) : value(a).localeCompare(value(b), "en", { numeric: true });
      return ascending ? order : -order;
    });
    body.append(...rows);
  };
  const cell = (text) => (/[",\n]/.test(text) ? '"' + text.replace(/"/g, '""') + '"' : text);
  const csv = (table) => [...table.rows].map(
    (row) => [...row.cells].map((c) => cell(c.textContent.trim())).join(",")).join("\n") + "\n";
  for (const [number, table] of document.querySelectorAll(".scroll > table").entries()) {
    const name = before(table);
    table.parentElement.setAttribute("aria-label", `table ${number + 1}: ${name}`);
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      if (table.tBodies[0].rows.length < 2) return;
      const words = document.createElement("button");
      words.type = "button"; words.title = "sort"; words.append(...head.childNodes);
      if (!words.textContent.trim()) words.setAttribute("aria-label", "sort by this column");
      words.addEventListener("click", () => sort(table, column, head));
      head.append(words);
    });
    const file = () => {
      const url = URL.createObjectURL(new Blob(["\ufeff" + csv(table)], { type: "text/csv" }));
      save(`${study}-${slug(name)}.csv`, url);
      setTimeout(() => URL.revokeObjectURL(url), 1000);
    };
    table.parentElement.before(tools(button("CSV", `CSV: save the table of ${name}`, file)));
    table.csv = () => csv(table);
    // What lies beyond the window fades out, so that one sees that there is more.
    const box = table.parentElement;
    const fade = () => box.toggleAttribute("data-more", box.scrollLeft + box.clientWidth < box.scrollWidth - 4);
    box.addEventListener("scroll", fade, { passive: true });
    new ResizeObserver(fade).observe(box);
  }
  // On paper nothing can be opened.
  let closed = [];
  addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details[data-printed]:not([open])")];
    for (const folded of closed) folded.open = true;
  });
  addEventListener("afterprint", () => { for (const folded of closed) folded.open = false; });
  for (const image of document.querySelectorAll("figure > img[src^='data:image/']")) {
    const kind = image.src.startsWith("data:image/svg") ? "svg" : "png";
    const name = kind.toUpperCase(), words = `${name}: save the picture: ${image.alt}`;
    image.after(tools(button(name, words, () => save(`${study}-${slug(image.alt)}.${kind}`, image.src))));
  }
})();
