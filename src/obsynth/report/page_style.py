"""The style of the page: dark on white, readable wide, narrow and printed; nothing is fetched."""

from __future__ import annotations

STYLE = """\
:root { --ink: #1a1c20; --soft: #5c626b; --line: #c9cdd3; --hair: #e7e9ec; --shade: #f6f7f8; --link: #1d4f91;
  --good: #14682b; --good-shade: #e9f5ec; --bad: #a80d26; --bad-shade: #fdecee; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif; color: var(--ink);
  background: #fff; margin: 0 auto; max-width: 74rem; padding: 2rem 2rem 5rem; overflow-wrap: break-word; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0; }
h2 { font-size: 1.25rem; margin: 3rem 0 0.9rem; padding-bottom: 0.3rem; border-bottom: 2px solid var(--ink); }
h3 { font-size: 1rem; margin: 1.6rem 0 0.5rem; }
p { max-width: 46rem; margin: 0.5rem 0; } ul { max-width: 46rem; padding-left: 1.2rem; }
.warning { color: #8a5300; }
.soft { color: var(--soft); font-weight: 400; }
.under { margin: 0.2rem 0 1.2rem; color: var(--soft); }
.verdict { max-width: none; border-left: 0.5rem solid; border-radius: 3px; padding: 0.9rem 1.2rem; margin: 1rem 0 0;
  font-size: 1.25rem; font-weight: 600; }
.verdict.holds { background: var(--good-shade); } .verdict.fails { background: var(--bad-shade); }
.holds { color: var(--good); } .fails { color: var(--bad); font-weight: 700; } .info { color: var(--soft); }
nav { margin: 1rem 0 0; display: flex; flex-wrap: wrap; gap: 0.2rem 1.3rem; } nav a { color: var(--link); }
.scroll { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: 0.4rem 1.2rem 0.4rem 0; }
th { font-weight: 600; white-space: nowrap; }
thead th { border-bottom: 1px solid var(--ink); vertical-align: bottom; }
tbody tr + tr > * { border-top: 1px solid var(--hair); }
td.number, th.number { text-align: right; white-space: nowrap; }
.copied td:first-child { white-space: nowrap; }
.facts th { color: var(--soft); font-weight: 400; padding-right: 1.6rem; }
.checks { width: 100%; } .checks td:last-child, .checks th:last-child { padding-right: 0; }
.checks tbody th { background: var(--shade); padding: 0.45rem 0.6rem; border-top: 1px solid var(--line); }
.checks .kind { display: block; color: var(--soft); font-size: 0.85rem; font-weight: 400; }
.checks td > div { color: var(--soft); font-size: 0.92rem; } .checks .claim { color: var(--ink); }
.checks td.source { color: var(--soft); font-size: 0.92rem; min-width: 9rem; }
.checks td:nth-child(2) { min-width: 18rem; width: 52%; }
.gains { display: flex; flex-wrap: wrap; gap: 0 3rem; } .gains > div { max-width: 100%; min-width: 0; }
.tall { max-height: 26rem; overflow-y: auto; }
.matrix { border-left: 2px solid var(--ink); border-right: 2px solid var(--ink); font-size: 0.92rem; }
.matrix td { padding: 0.15rem 0.7rem; border: 0 !important; } .matrix .zero { color: #9aa0a8; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(30rem, 100%), 1fr)); gap: 1rem 2.5rem;
  align-items: start; }
figure { margin: 0; min-width: 0; } figure.wide { grid-column: 1 / -1; max-width: 50rem; }
figure h3 { margin: 0.8rem 0 0.3rem; }
img { display: block; width: 100%; height: auto; } figcaption { color: var(--soft); font-size: 0.95rem; }
pre { background: var(--shade); border: 1px solid var(--hair); border-radius: 3px; padding: 0.8rem 1rem;
  margin: 0.6rem 0; overflow-x: auto; font: 0.9rem/1.5 ui-monospace, "Liberation Mono", Menlo, Consolas, monospace; }
.digest { font-family: ui-monospace, "Liberation Mono", Menlo, Consolas, monospace; overflow-wrap: anywhere; }
@media (max-width: 56rem) {
  .copied th, .copied td:first-child { white-space: normal; } .copied th, .copied td { padding-right: 0.5rem; }
  .copied { font-size: 0.8rem; }
  body { padding: 1.1rem 1.1rem 3rem; } h1 { font-size: 1.4rem; } h2 { margin-top: 2.2rem; }
  .verdict { font-size: 1.1rem; padding: 0.7rem 0.9rem; }
  .checks thead { display: none; }
  .checks, .checks tbody, .checks tr { display: block; }
  .checks tbody th { display: block; white-space: normal; margin-top: 0.8rem; }
  .checks tr { padding: 0.55rem 0; } .checks tr + tr { border-top: 1px solid var(--hair); }
  .checks td, .checks tr > * { border: 0 !important; padding: 0; display: block; min-width: 0 !important;
    width: auto !important;     overflow-wrap: anywhere; }
  .checks td.word { float: right; margin-left: 0.8rem; text-align: right; }
  .checks td.none { display: none; } .checks td.number:not(.none) { display: inline-block; text-align: left;
    margin-right: 1rem; font-size: 0.92rem; }
  .checks td[data-label]:not(.word)::before { content: attr(data-label) " "; color: var(--soft); }
  .facts tr { display: grid; grid-template-columns: 8rem 1fr; padding: 0.3rem 0; }
  .facts tr + tr { border-top: 1px solid var(--hair); }
  .facts, .facts tbody { display: block; } .facts th, .facts td { border: 0 !important; padding: 0; }
  .facts th { padding-right: 0.9rem; white-space: normal; } .facts td + td { grid-column: 1 / -1; color: var(--soft); }
  .facts td { overflow-wrap: anywhere; }
}
@media print {
  @page { margin: 16mm 14mm; } body { max-width: none; padding: 0; font-size: 10pt; } nav { display: none; }
  h2 { break-after: avoid; margin-top: 1.6rem; } h3 { break-after: avoid; } tr, figure { break-inside: avoid; }
  .verdict, .checks tbody th, pre { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  .scroll { overflow: visible; max-height: none; }
  .matrix { font-size: 7.5pt; } pre { white-space: pre-wrap; overflow-wrap: anywhere; }
  .checks td:nth-child(2) { min-width: 0; } .checks td.source { min-width: 0; }
}
"""
