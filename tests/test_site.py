"""The hooks of the documentation's site: what pages show is found from where they are served."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from tests.scripts import module_at

ROOT = Path(__file__).parents[1]


@pytest.fixture
def hooks(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Those of mkdocs.yml, without the packages that only the site needs."""
    monkeypatch.setitem(sys.modules, "griffe", SimpleNamespace(Extension=object))
    return module_at(ROOT / "scripts/site_hooks.py")


def test_pictures_of_html_are_led_to_from_the_folder_that_a_page_becomes_and_those_of_markdown_from_the_page(
    hooks: ModuleType,
) -> None:
    html, markdown = '<img src="pictures/viewer.jpg">', "![two](pictures/viewer.jpg)"
    assert hooks.moved(html, "docs/tasks.md", "tasks.md", {}) == '<img src="../pictures/viewer.jpg">'
    assert hooks.moved(markdown, "docs/tasks.md", "tasks.md", {}) == markdown
    readme = html.replace("pictures", "docs/pictures")
    assert hooks.moved(readme, "README.md", "index.md", {}) == html


def test_a_site_with_a_picture_that_is_not_there_is_refused(hooks: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "plan.png").touch()
    (tmp_path / "tasks/index.html").write_text('<img alt="a" src="../plan.png"><img src="https://a.example/b.png">')
    site = SimpleNamespace(site_dir=str(tmp_path))
    hooks.on_post_build(site)
    (tmp_path / "index.html").write_text('<iframe src="plan.png"></iframe><img src="pictures/plan.png">')
    with pytest.raises(FileNotFoundError, match=r"^index\.html: pictures/plan\.png$"):
        hooks.on_post_build(site)


def test_styles_that_the_site_asks_for_are_made_and_its_404_page_knows_where_it_is_served(hooks: ModuleType) -> None:
    said = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert re.findall(r"^extra_css: \[(.*?)\]", said, re.MULTILINE) == [", ".join(hooks.STYLES)]
    assert re.search(r"^site_url: !ENV \[SITE_URL, \"\"\]", said, re.MULTILINE)
    assert "SITE_URL='$(SITE_URL)'" in (ROOT / "Makefile").read_text(encoding="utf-8")
