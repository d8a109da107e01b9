"""The site without building it: its menu, its links, and the pages that are made from the code."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
GENERATED = {f"reference/{name}.md" for name in ("cli", "components", "spec-schema")}


@pytest.fixture
def made(monkeypatch):
    """scripts/docs_pages.py as a module."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    import docs_pages

    yield docs_pages
    del sys.modules["docs_pages"]


def menu() -> list[str]:
    paths = re.findall(r"[\w/-]+\.md", yaml.safe_dump(yaml.safe_load(MKDOCS.read_text())["nav"]))
    assert len(paths) == len(set(paths))
    return paths


MKDOCS = ROOT / "mkdocs.yml"
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))


def test_the_menu_leads_to_every_page():
    # reference pages that it does not list are added by the hook
    missing = {page for page in PAGES if not page.startswith("reference/")} - set(menu())
    assert not missing
    assert set(menu()) - set(PAGES) == GENERATED


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", (DOCS / page).read_text(), flags=re.S)
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if "://" not in target:
            path = (DOCS / page).parent / target
            inside = path.resolve().relative_to(DOCS.resolve())  # a site has nothing else
            assert path.exists() or str(inside) in GENERATED, f"{page}: {target}"


def test_every_command_and_option_is_there(made):
    page = made.cli_page()
    commands = ("train", "prepare", "plugins new", "plugins show", "spec check", "study compare")
    for command in commands:
        assert f"## hoigs {command}\n" in page
    resume = "Continue the run in --out, with its own spec and clip unless others are given."
    assert f"| `--resume` | {resume} |  |" in page
    slow = "Play this many times slower, with moments between frames computed by the model."
    assert f"| `--slow` | {slow} | `1.0` |" in page


def test_the_schema_page_has_every_key(made):
    page = made.schema_page()
    assert "| `steps` | `int >= 1` | `2000` | Optimizer steps, one frame each. |" in page
    assert "| `loss.lambda_dssim` | `float >= 0 and <= 1` | `0.2` |" in page
    assert "| `deformation.use` |" in page or "| `deformation` |" in page


def test_the_gallery_has_every_component_with_its_settings(made, monkeypatch):
    from hoigs.plugins.builtin import PARTS

    kept = ("rasterizer:torch",)  # the others take as long again
    monkeypatch.setattr(made, "PREVIEWS", {k: made.PREVIEWS[k] for k in kept})
    files = made.component_pages()
    page = files["reference/components.md"]
    assert {line.removeprefix("### ") for line in page.splitlines() if line.startswith("### ")} == {
        part[0] for part in PARTS
    }
    assert "| `keyframe_step` | `int >= 1` | `4` | Frames between knots (the paper's 4). |" in page
    for picture in re.findall(r"\]\((pictures/[^)]+)\)", page):
        assert files[f"reference/{picture}"].startswith(b"\x89PNG")


def test_the_api_page_is_that_of_the_code():
    script = runpy.run_path(str(ROOT / "scripts" / "api_page.py"))
    import hoigs

    page = script["text"]()
    for name in hoigs._PUBLIC:
        assert f"### h.{name}\n" in page
    assert "### h.metrics.psnr\n" in page
    assert script["PAGE"].read_text() == page, "run scripts/api_page.py"
