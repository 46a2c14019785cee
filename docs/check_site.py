"""Check a built site: ``python docs/check_site.py FOLDER``.

No page fetches a script or a style from a network, every page with formulas has the site's own MathJax, and, where there is a
Chromium, no formula is left as TeX once a browser without a network has shown the page.
"""

from __future__ import annotations

import html
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

#: Pages that a browser opens: a paper's derivation, a nonlinear plant, a docstring with formulas.
OPENED = (
    "made/01_fault_estimation_filter.html",
    "made/05_nonlinear_dae.html",
    "made/api/obsynth.DescriptorSystem.html",
)
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
#: Milliseconds that a page has to draw its formulas.
PATIENCE = 20_000


def problems_of(page: Path, site: Path) -> list[str]:
    """Return what a page would need a network for."""
    text = page.read_text(encoding="utf-8")
    loaded = re.findall(r'<(?:script|link)[^>]+(?:src|href)="([^"]+)"', text)
    # A page may link to others; what it loads is a script, a style or a font.
    foreign = [name for name in loaded if re.match(r"(https?:)?//", name) and not re.search(r"canonical|search", name)]
    found = [f"{page.relative_to(site)} loads {name}" for name in foreign]
    if 'class="math' in text and not any("mathjax.js" in name for name in loaded):
        found.append(f"{page.relative_to(site)} has formulas and no MathJax of its own")
    return found


def raw_tex(page: Path) -> list[str]:
    """Return the formulas that a browser without a network leaves as TeX."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
            f"--user-data-dir={folder}", "--no-first-run", "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--virtual-time-budget={PATIENCE}", "--dump-dom", page.resolve().as_uri(),
        ]  # fmt: skip
        shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout
    body = re.sub(r"<(script|style|pre|mjx-assistive-mml)\b.*?</\1>", "", shown, flags=re.DOTALL)
    words = html.unescape(re.sub(r"<[^>]+>", " ", body))
    left = re.findall(r"\\[\[(][^\n]{0,60}", words)
    return left if "<mjx-container" in shown else [*left, "no formula was drawn"]


def main() -> int:
    """Return 1 where something is wrong, after saying what."""
    site = Path(sys.argv[1])
    pages = sorted(site.rglob("*.html"))
    found = [problem for page in pages for problem in problems_of(page, site)]
    if not (site / "_static/mathjax.js").is_file():
        found.append("_static/mathjax.js is missing")
    for name in OPENED if BROWSER else ():
        found += [f"{name} shows {text!r}" for text in raw_tex(site / name)]
    print("\n".join(found) or f"{len(pages)} pages need no network{', as a browser shows' if BROWSER else ''}.")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
