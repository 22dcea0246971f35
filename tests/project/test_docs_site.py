"""The site builds without a warning: links within it lead somewhere, names in it exist."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import cfr_jax

ROOT = Path(__file__).parents[2]

pytest.importorskip("sphinx", reason="the site needs the docs extra")
pytest.importorskip("furo", reason="the site needs the docs extra")
pytest.importorskip("myst_parser", reason="the site needs the docs extra")


class Links(HTMLParser):
    """Where a page leads, what it loads, and the places in it."""

    def __init__(self, page: Path):
        super().__init__()
        self.leads, self.loads, self.places = [], [], set()
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if given.get("id"):
            self.places.add(given["id"])
        if tag == "a" and given.get("href"):
            self.leads.append(given["href"])
        loaded = given.get("src") or (given.get("href") if tag == "link" else None)
        if loaded and given.get("rel") not in ("index", "search", "next", "prev", "canonical"):
            self.loads.append(loaded)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> dict[Path, Links]:
    """The pages of the site, built with warnings as errors."""
    out = tmp_path_factory.mktemp("site")
    sphinx = [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "-q"]
    child = subprocess.run([*sphinx, "docs", str(out)], cwd=ROOT, capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
    return {page: Links(page) for page in out.rglob("*.html")}


def test_every_link_within_the_site_leads_to_a_place_that_is_there(site):
    assert sum(len(links.leads) for links in site.values()) > 100
    for page, links in site.items():
        for lead in links.leads:
            parts = urlsplit(lead)
            if parts.scheme:
                continue
            goal = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            assert goal.exists(), f"{page.name}: {lead}"
            if parts.fragment and goal in site:
                assert unquote(parts.fragment) in site[goal].places, f"{page.name}: {lead}"


def test_the_reference_has_every_public_name(site):
    (page,) = (page for page in site if page.name == "api.html")
    for name in cfr_jax.__all__:
        assert name == "__version__" or f"cfr_jax.{name}" in site[page].places, name


def test_the_site_loads_nothing_from_elsewhere(site):
    assert sum(len(links.loads) for links in site.values()) > len(site) > 10
    for page, links in site.items():
        for loaded in links.loads:
            assert urlsplit(loaded).scheme in ("", "data"), f"{page.name}: {loaded}"


def test_the_answers_to_what_users_ask_are_all_there():
    text = (ROOT / "docs" / "comparison.md").read_text("utf-8")
    table = text.partition("| asked for |")[2]
    rows = [line for line in table.splitlines()[2:] if line.startswith("|")]
    assert len(rows) == 12
    for row in rows:
        shown = row.rstrip("| ").rpartition("|")[2]
        assert re.fullmatch(r" `cfr [^`]+`", shown), row


def test_the_summary_of_the_results_is_made_of_the_tables_below_it():
    pytest.importorskip("matplotlib", reason="the figure needs the viz extra")
    made = runpy.run_path(str(ROOT / "docs" / "summary.py"))
    text = (ROOT / "docs" / "results.md").read_text("utf-8")
    written = text.partition(made["BEGIN"])[2].partition(made["END"])[0]
    assert written == made["in_markdown"](made["summary"](text))
    assert len(written.splitlines()) > 12


def test_every_measured_number_of_the_comparison_is_in_the_results():
    """Rounded there as here; the published numbers stand in a column of their own."""
    results = (ROOT / "docs" / "results.md").read_text("utf-8")
    known = {float(number) for number in re.findall(r"\d+\.\d+|\d+", results)}
    text = (ROOT / "docs" / "comparison.md").read_text("utf-8")
    table = text.partition("| method | published")[2].partition("\n\n")[0]
    measured = [line.strip("|").split("|")[2] for line in table.splitlines()[2:]]
    numbers = re.findall(r"\d+\.\d+|\d+", re.sub(r"`[^`]*`", "", " ".join(measured)))
    assert len(numbers) > 20
    for number in numbers:
        half = 0.51 / 10 ** len(number.partition(".")[2])
        assert any(abs(each - float(number)) < half for each in known), number
