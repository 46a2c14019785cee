"""The HTML page in a real browser: it renders, asks for nothing, fits a wide and a narrow screen, and prints.

The page has no script.  What the browser made of it is measured by a copy with one, in headless Chromium.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import obsynth
from obsynth.report.page import html_report
from obsynth.results.verification_report import VerificationReport
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine: apt-get install chromium")

#: A screen on a desk and a phone, in pixels.
WIDTHS = (1400, 400)
#: Elements that stick out of the window, unless a box of their own scrolls or hides them; and what was fetched.
MEASURE = """
<script>
addEventListener("load", () => {
  const boxed = element => {
    for (let up = element; up && up !== document.body; up = up.parentElement)
      if (getComputedStyle(up).overflowX !== "visible") return true;
    return false;
  };
  const out = [...document.body.querySelectorAll("*")].filter(element =>
    element.getBoundingClientRect().right > innerWidth + 0.5 && !boxed(element.parentElement));
  const verdict = document.querySelector(".verdict");
  const found = {
    width: innerWidth, page: document.documentElement.scrollWidth,
    out: out.map(element => element.outerHTML.slice(0, 90)),
    images: [...document.images].map(image => [image.naturalWidth, image.getBoundingClientRect().width]),
    fetched: performance.getEntriesByType("resource").map(entry => entry.name).filter(
      name => !name.startsWith("data:")),
    ink: getComputedStyle(verdict).color, paper: getComputedStyle(document.body).backgroundColor,
    top: verdict.getBoundingClientRect().top, scrolls: [...document.querySelectorAll(".scroll")].filter(
      box => box.scrollWidth > box.clientWidth + 1).length,
  };
  parent.document.body.dataset[`found${innerWidth}`] = JSON.stringify(found);
});
</script>
"""


def opened(page: Path, tmp_path: Path, *arguments: str) -> str:
    """Return what headless Chromium prints about a page; it may ask nobody for anything."""
    command = [
        str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
        f"--user-data-dir={tmp_path / 'profile'}", "--no-first-run", "--disable-extensions",
        "--disable-background-networking", "--host-resolver-rules=MAP * ~NOTFOUND", *arguments, page.as_uri(),
    ]  # fmt: skip
    environment = {**os.environ, "HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path)}
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120, env=environment).stdout


def measured(page: Path, tmp_path: Path) -> dict[int, dict[str, object]]:
    """Return what frames of each width show: a window of the browser itself is not narrower than 500 pixels."""
    text = page.read_text(encoding="utf-8").replace("</body>", f"{MEASURE}</body>")
    frames = "".join(
        f'<iframe style="border: 0; width: {width}px; height: 900px" srcdoc="{escape(text)}"></iframe>'
        for width in WIDTHS
    )
    host = tmp_path / "host.html"
    host.write_text(f"<!DOCTYPE html><body>{frames}</body>", encoding="utf-8")
    dom = opened(host, tmp_path, "--window-size=1600,1000", "--dump-dom")
    found = re.findall(r'data-found(\d+)="([^"]*)"', dom[: dom.index("<iframe")])
    assert sorted(int(width) for width, _ in found) == sorted(WIDTHS)
    return {int(width): json.loads(unescape(data)) for width, data in found}


@pytest.fixture(scope="module", params=["wang2015", "sharepasand", "moussaali2013_ltv"])
def page(request, tmp_path_factory) -> Path:
    spec = load_spec(DESIGNS / request.param / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options))
    return html_report(design, tmp_path_factory.mktemp("page") / f"{request.param}.html", gains_file="gains.json")


@pytest.mark.one_in(3)
@needs_browser
def test_the_page_renders_and_nothing_sticks_out(page: Path, tmp_path: Path) -> None:
    for width, found in measured(page, tmp_path).items():
        assert found["fetched"] == []
        assert (found["page"], found["out"]) == (width, [])
        # The verdict is on the first screen, in a colour of its own on white.
        assert 0 < found["top"] < 400
        assert (found["ink"], found["paper"]) == ("rgb(20, 104, 43)", "rgb(255, 255, 255)")
        assert len(found["images"]) >= 2
        for natural, shown in found["images"]:
            assert natural > 300
            assert 300 < shown <= width


@pytest.mark.long
@needs_browser
def test_the_measurement_sees_what_sticks_out_and_what_is_fetched(tmp_path: Path) -> None:
    broken = tmp_path / "broken.html"
    broken.write_text(
        '<!DOCTYPE html><body><p class="verdict" style="width: 900px">wide</p>'
        '<img src="http://x.example/a.png"></body>', encoding="utf-8",
    )  # fmt: skip
    found = measured(broken, tmp_path)
    assert found[400]["page"] > 400
    assert "wide" in str(found[400]["out"])
    assert found[1400]["out"] == []
    assert found[1400]["fetched"] == ["http://x.example/a.png"]


@pytest.mark.long
@needs_browser
def test_a_wide_matrix_scrolls_in_its_own_box_and_a_failure_is_red(tmp_path: Path) -> None:
    spec = load_spec(DESIGNS / "wang2015" / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method).replace(gains={"wide": np.full((4, 40), 1.23456)})
    failed = VerificationReport.of(
        type(check)(**{**check.__dict__, "passed": False}) if i == 8 else check
        for i, check in enumerate(design.report.checks)
    )
    page = html_report(design, tmp_path / "report.html", report=failed)
    for width, found in measured(page, tmp_path).items():
        assert (found["page"], found["out"]) == (width, [])
        assert found["scrolls"] >= 1
        assert found["ink"] == "rgb(168, 13, 38)"


@pytest.mark.one_in(3)
@needs_browser
def test_the_page_prints(page: Path, tmp_path: Path) -> None:
    file = tmp_path / "page.pdf"
    opened(page, tmp_path, f"--print-to-pdf={file}", "--no-pdf-header-footer")
    data = file.read_bytes()
    assert data.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", data)) >= 2
