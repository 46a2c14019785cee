"""The style of the page: readable wide, narrow, printed, and in the dark; nothing is fetched."""

from __future__ import annotations

STYLE = """\
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #fff; --soft: #666; --line: #ccc; --good: #176b2c;
  --bad: #b00020; --shade: #f4f4f2; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e6; --paper: #161616; --soft: #a0a0a0; --line: #444;
  --good: #6fd08a; --bad: #ff8a80; --shade: #222; } img { background: #fff; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0 auto;
  max-width: 72rem; padding: 1rem 1.25rem 4rem; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; margin: 0.5rem 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 0.6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.4rem; }
.verdict { border-left: 0.5rem solid; padding: 0.6rem 1rem; font-size: 1.15rem; font-weight: 600;
  background: var(--shade); }
.holds { color: var(--good); } .fails { color: var(--bad); font-weight: 700; } .info, .soft { color: var(--soft); }
table { border-collapse: collapse; }
th, td { text-align: left; vertical-align: top; padding: 0.25rem 0.9rem 0.25rem 0; }
thead th { border-bottom: 1px solid var(--line); } tbody tr + tr td { border-top: 1px solid var(--shade); }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; overflow-wrap: normal; }
.scroll { overflow-x: auto; max-width: 100%; } .matrix td { padding-right: 1rem; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; } figcaption { color: var(--soft); }
pre { background: var(--shade); padding: 0.8rem; overflow-x: auto; white-space: pre-wrap; }
@media (max-width: 46rem) {
  table.checks thead { display: none; }
  table.checks, table.checks tbody, table.checks tr, table.checks td { display: block; }
  table.checks tr { border-top: 1px solid var(--line); padding: 0.5rem 0; }
  table.checks td { border: 0 !important; padding: 0; } table.checks td.number { text-align: left; }
  table.checks td[data-label]::before { content: attr(data-label) ": "; color: var(--soft); }
}
@media print { body { max-width: none; } h2 { break-after: avoid; } tr, figure { break-inside: avoid; } }
"""
