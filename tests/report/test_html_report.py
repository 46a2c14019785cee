"""The HTML page: complete in itself, verdict first, every text escaped, numbers and pictures those of the design."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest

mpl.use("Agg")

import obsynth
from obsynth.errors import SpecError
from obsynth.methods.ui_pi_observer.unmodelled_faults import tracking_response
from obsynth.methods.verifying import verify
from obsynth.numerics.spectra import boundary_points
from obsynth.plotting import estimate_gains, plot_gains, plot_poles
from obsynth.report.page import html_report
from obsynth.results.verification_report import VerificationReport
from obsynth.specs.loader import load_spec

ROOT = Path(__file__).parents[2]
VOID = {"meta", "img", "br", "link"}
NASTY = '<script src="http://x.example/a.js">alert(1)</script>&amp;\'"'


class Page(HTMLParser):
    """Tags, their attributes, and the text of a page; a tag that is not closed is an error."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if data.strip() and (not self.open or self.open[-1] != "style"):
            self.texts.append(data.strip())

    @property
    def text(self) -> str:
        return " ".join(self.texts)


def exact(plant):
    return plant.replace(uncertainty=None) if isinstance(plant, obsynth.DescriptorSystem) else plant


def designed(path: str) -> obsynth.ObserverDesign:
    """Return a design of an exact model: what its tolerances add is asked of the drive alone."""
    spec = load_spec(ROOT / "designs" / path)
    recovery = None if spec.transformation is None else spec.transformation.recovery
    return obsynth.design(exact(spec.plant), spec.method, name=spec.name, recovery=recovery, **dict(spec.options))


@pytest.fixture(scope="module")
def network() -> obsynth.ObserverDesign:
    return designed("smib/spec.yaml")


@pytest.fixture(scope="module")
def continuous() -> obsynth.ObserverDesign:
    return designed("sharepasand/spec.yaml")


@pytest.fixture(scope="module")
def recursive() -> obsynth.ObserverDesign:
    return designed("moussaali2013_ltv/spec.yaml")


@pytest.fixture(scope="module", autouse=True)
def _drawn_once():
    """Pictures and tolerances of a design are made once: most tests are about what stands around them."""
    from obsynth.report import designs as report_tables
    from obsynth.report import page, pictures

    patch, drawn, told, pictures_of = pytest.MonkeyPatch(), {}, {}, pictures.pictures_of

    def pictures_once(design, *, scenario=None):
        if scenario is not None:
            return pictures_of(design, scenario=scenario)
        # The plant changes alone where its tolerances go.
        key = design.observer, design.name
        if key not in drawn:
            drawn[key] = list(pictures_of(design))
        return drawn[key]

    def facts_once(design):
        # The report is asked for nothing but whether it fails.
        key = design.plant, design.observer, bool(design.report.checks) and not design.report.passed
        if key not in told:
            told[key] = report_tables.tolerance_facts(design)
        return told[key]

    patch.setattr(page, "pictures_of", pictures_once)
    patch.setattr(page, "tolerance_facts", facts_once)
    yield
    patch.undo()


def page_of(design, tmp_path, **more) -> tuple[str, Page]:
    text = html_report(design, tmp_path / "report.html", **more).read_text(encoding="utf-8")
    return text, Page(text)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("which", ["network", "continuous", "recursive"])
def test_the_page_needs_nothing_else(request, tmp_path, which):
    text, page = page_of(request.getfixturevalue(which), tmp_path)
    assert {tag for tag, _ in page.tags} & {"link", "iframe", "object", "base", "form"} == set()
    # One script, which is ours, draws the plots that can be zoomed: it asks nobody for anything.
    assert text.count("<script") == 1
    script = text.partition("<script>")[2].partition("</script>")[0]
    assert script.startswith("/* uPlot")
    assert not re.search(r"fetch\(|XMLHttpRequest|WebSocket|importScripts|sendBeacon", script)
    sources = [attributes["src"] for _, attributes in page.tags if "src" in attributes]
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    # The design at work and its states; of linear ones the spectrum, and gains to faults and states.
    assert len(sources) == (2 if which == "recursive" else 5)
    for source in sources:
        assert base64.b64decode(source.partition(",")[2]).startswith(b"\x89PNG\r\n\x1a\n")
    links = [attributes["href"] for _, attributes in page.tags if "href" in attributes]
    anchors = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    assert {link.removeprefix("#") for link in links} == anchors
    assert not any("srcset" in attributes for _, attributes in page.tags)
    assert "url(" not in text
    assert "@import" not in text
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)


def test_the_verdict_comes_first(network, tmp_path):
    _, page = page_of(network, tmp_path)
    assert page.texts[1] == "smib: fault-estimation-filter"
    # What can be detected, how small and how soon; then whether it is verified.
    assert page.texts[2] == "What can be detected"
    sentence = (
        r"tm GENCLS 1: 0\.202 pu exceeds 5 standard deviations .* after .*; a sine of amplitude 1 pu in active power"
    )
    assert re.match(sentence, page.texts[3])
    assert re.fullmatch(r"Verified: all \d+ checks hold\.", page.texts[4])


def test_a_failure_is_said_at_the_top_and_in_its_row(network, tmp_path):
    first, *others = network.report.checks
    broken = VerificationReport((type(first)(**{**first.__dict__, "passed": False, "kind": "computed"}), *others))
    text, page = page_of(network, tmp_path, report=broken)
    assert page.texts[2].startswith("FAILS: 1 of")
    assert first.name in page.texts[2]
    assert text.count('data-label="verdict">FAILS') == 1
    assert page_of(network, tmp_path, report=VerificationReport())[1].texts[2].startswith("FAILS: the report is empty")


@pytest.mark.long
@pytest.mark.parametrize("which", ["network", "continuous", "recursive"])
def test_everything_is_there(request, tmp_path, which):
    design = request.getfixturevalue(which)
    _, page = page_of(design, tmp_path, gains_file="my gains.json")
    digest, claims = json.loads(design.save(tmp_path / "gains.json").read_text())["sha256"], design.certificate.claims
    for check in design.report.checks:
        assert check.name in page.texts, check.name
        assert check.claim in page.text
    for note in design.notes:
        assert note in page.text
    for name in (*design.gains, *(name.replace("_", " ") for name in claims), *design.plant.output_names):
        assert name in page.text
    assert digest in page.texts
    assert "obsynth verify 'my gains.json'" in page.text
    gain = next(iter(design.gains.values()))
    assert f"{gain.ravel()[0]:.6g}" in page.texts


@pytest.mark.long
def test_an_observer_that_does_not_fit_or_is_unstable_has_a_page_too(continuous, tmp_path):
    _, observer = continuous.linear
    short = type(observer)(**{**observer.as_dict(), "By": observer.By[:, :1], "Dy": observer.Dy[:, :1],
                              "output_names": observer.output_names[:1]})  # fmt: skip
    wrong = continuous.replace(observer=short)
    _, page = page_of(wrong, tmp_path, report=verify(wrong))
    assert page.texts[2].startswith("FAILS")
    assert "None: the observer does not fit its plant." in page.texts
    unstable = continuous.replace(observer=type(observer)(**{**observer.as_dict(), "Az": -observer.Az}))
    _, page = page_of(unstable, tmp_path, report=verify(unstable))
    assert page.texts[2].startswith("FAILS")
    assert "What fails" in page.texts


def test_a_kalman_filter_shows_its_states(tmp_path):
    plant = obsynth.TimeVaryingDescriptorSystem(
        E=None, A=[["0.9 + 0.05 * sin(k)", 0.1], [0, 0.5]], C=[[1, 0]], dt=1.0, horizon=100
    )
    _, page = page_of(obsynth.descriptor_kalman(plant, Q=1e-4, R=1e-2), tmp_path)
    assert sum(tag == "img" for tag, _ in page.tags) == 1
    assert "States in a run with the stated noise, and their estimates, with 95 % bands." in page.texts


@pytest.mark.long
def test_a_scenario_is_shown_with_its_alarm(tmp_path):
    spec = load_spec(ROOT / "designs" / "wang2015" / "spec.yaml")
    design = obsynth.fault_estimation_filter(exact(spec.plant))
    _, page = page_of(design, tmp_path, scenario=spec.scenario, system_file="my spec.yaml", gains_file="g.json")
    assert "On the scenario: 300 s, seed 2015." in page.texts
    assert "obsynth report --gains g.json --out report.html --system 'my spec.yaml'" in page.text
    with pytest.raises(SpecError, match="nothing"):
        page_of(design, tmp_path, scenario=spec.scenario.replace(faults={"nothing": obsynth.Step(size=1)}))


@pytest.mark.long
def test_every_text_is_escaped(continuous, tmp_path):
    plant, observer = continuous.linear
    changed = continuous.replace(
        name=NASTY, method=NASTY, notes=(NASTY,), gains={NASTY: np.eye(2)}, options={NASTY: NASTY},
        plant=plant.replace(output_names=[NASTY, "y2"]),
        observer=type(observer)(**{**observer.as_dict(), "output_names": (NASTY, "y2")}),
        report=VerificationReport(
            tuple(
                type(check)(**{**check.__dict__, "name": NASTY, "claim": NASTY, "detail": NASTY, "source": NASTY})
                for check in continuous.report.checks[:2]
            )
        ),
    )  # fmt: skip
    text, page = page_of(changed, tmp_path, gains_file=NASTY)
    assert text.count("<script") <= 1
    assert "x.example" not in re.sub(r"&lt;script[^<]*", "", text)
    usual = {tag for tag, _ in page_of(continuous, tmp_path)[1].tags}
    assert {tag for tag, _ in page.tags} <= usual | {"ul", "li"}
    assert page.texts.count(NASTY) >= 4


def test_the_page_fits_a_narrow_screen(network, tmp_path):
    """What can be wide scrolls by itself or folds up, and the numbers keep their names."""
    text, page = page_of(network, tmp_path)
    assert ("meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"}) in page.tags
    assert "@media (max-width" in text
    tables = sum(tag == "table" for tag, _ in page.tags)
    assert tables == sum(str(attributes.get("class")).startswith("scroll") for _, attributes in page.tags)
    labels = [attributes["data-label"] for _, attributes in page.tags if "data-label" in attributes]
    for label in ("value", "bound", "margin", "verdict"):
        assert labels.count(label) == len(network.report.checks)


class TestPictures:
    def test_the_gain_from_disturbances_peaks_at_the_verified_norm(self, network):
        """The norm is recomputed on a pencil by `verify`, the curve from plant and realisation: two routes."""
        peak = estimate_gains(network).gains["disturbances"].max()
        norm = network.report["H-infinity norm"].value
        assert 0.98 * norm <= peak <= norm * (1.0 + 1e-9)

    def test_a_filter_that_only_delays_faults_has_gain_one(self, network):
        assert np.allclose(estimate_gains(network).gains["faults"], 1.0, rtol=0.0, atol=1e-6)

    @pytest.mark.long
    def test_faults_are_those_of_the_tracking_analysis(self, continuous):
        found = estimate_gains(continuous)
        wanted = np.abs(obsynth.fault_response(continuous, found.frequencies)[:, 0, 0])
        assert np.allclose(found.gains["faults"], wanted, rtol=1e-6)

    @pytest.mark.long
    def test_decoupled_disturbances_are_said_not_to_get_through(self, continuous):
        assert not estimate_gains(continuous).gains["disturbances"].any()
        labels = [text.get_text() for text in plot_gains(continuous).get_legend().get_texts()]
        assert labels == ["faults to fault estimates", "disturbances: zero gain"]

    def test_poles_are_those_of_the_observer(self, continuous):
        (points,) = [line for line in plot_poles(continuous).get_lines() if line.get_marker() == "x"]
        wanted = np.linalg.eigvals(continuous.observer.Az)
        assert np.allclose(np.sort(points.get_xdata()), np.sort(wanted.real))

    @pytest.mark.long
    def test_a_recursive_design_has_none(self, recursive):
        with pytest.raises(SpecError, match="no linear time-invariant observer"):
            plot_gains(recursive)


@pytest.mark.long
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_plant_that_is_not_regular_has_its_page_and_its_gains(dt: float, tmp_path: Path) -> None:
    # Two equations are missing; what is measured stands in for them.  The third state moves freely.
    plant = obsynth.DescriptorSystem(
        E=[[1e-3, 0, 0], [0, 0, 0], [0, 0, 0]], A=[[-0.5e-3 if dt == 0.0 else 0.9e-3, 2.0, 0], [0, 0, 0], [0, 0, 0]],
        B=[[1.0], [0], [0]], C=np.eye(3), Bf=[[1.0], [0], [0]], dt=dt,
    )  # fmt: skip
    design = obsynth.ui_pi_observer(plant)
    assert html_report(design, tmp_path / "page.html").read_text().count("data:image/png") >= 3
    for to in ("faults", "states"):
        found = estimate_gains(design, to=to)
        # The same by the way of the verification, which asks for no state of the plant.
        if to == "faults":
            tracking = design.certificate.matrices["tracking"]
            points = boundary_points(found.frequencies, dt)
            expected = np.abs(tracking_response(*design.linear, tracking, points)[:, 0, 0])
            np.testing.assert_allclose(found.gains["faults"], expected, rtol=1e-6, atol=1e-9)
        else:
            assert np.all(np.isfinite(found.gains["faults"]))


@pytest.mark.long
def test_the_page_says_what_holds_within_the_tolerances(tmp_path: Path) -> None:
    spec = load_spec(ROOT / "designs" / "drive" / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    page = html_report(design, tmp_path / "p.html").read_text(encoding="utf-8")
    assert "<h2>Tolerances</h2>" in page
    assert "bounds stay finite for ever" in page
    bare = design.replace(plant=design.plant.replace(uncertainty=None))
    assert "every claim is for the exact model" in html_report(bare, tmp_path / "q.html").read_text(encoding="utf-8")


@pytest.mark.long
def test_a_log_without_a_rule_for_alarms_is_not_said_to_be_free_of_them(continuous, tmp_path):
    log = pd.DataFrame({"time": np.arange(40) * 0.1, **{name: 0.0 for name in continuous.plant.output_names}})
    for name in continuous.plant.input_names:
        log[name] = 0.0
    run = obsynth.run_on_data(continuous, log)
    text = html_report(continuous, tmp_path / "page.html", run=run).read_text(encoding="utf-8")
    assert 'class="verdict undecided">40 rows; no alarm rule is set' in text
    assert "No alarm" not in text
