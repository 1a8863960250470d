"""The API reference: it contains the text of every public name, and its links are checked."""

import html
import re
from pathlib import Path

import pytest
from docs.reference import ROOMS, build, link_faults, list_modules, main
from docs.site import build_site, draw_pictures

import polysight


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    """Pages of the public interface and of the rooms behind it."""
    out = tmp_path_factory.mktemp("reference")
    rooms = ("polysight", "polysight.api", *(f"polysight.{room}" for room in ROOMS))
    names = [name for room in rooms for name in list_modules(room)]
    assert names == list(rooms), "a package that names its public functions has one page"
    build([*names, "polysight_shared"], out)
    build_site(out, run=False)
    return out


def test_every_public_name_is_on_the_page_with_its_text(reference):
    page = (reference / "polysight.html").read_text(encoding="utf-8")
    for name in set(polysight.__all__) - {"__version__"}:
        assert f'id="{name}"' in page
    for text in ("metal_box_mm", "Reference library of the materials", "complex64 [y_mm, x_mm]"):
        assert text in page


def test_types_of_public_functions_are_read_and_followed(reference):
    """Types of results have their own pages; arrays have the type names of the sources."""
    page = (reference / "polysight.html").read_text(encoding="utf-8")
    for name in ("results.html#Verdict", "materials.html#Score", "planning.html#Forecast", "products.html#Rows"):
        assert f'href="polysight/{name}"' in page
    text = re.sub(r"<[^>]+>", "", page)
    assert "X: ArrayLike" in text
    assert "NDArray[float64]" in text
    for hidden in ("numpy._typing", "numpy.ndarray[", "set_fit_request"):
        assert hidden not in text


def test_links_between_the_pages_lead_somewhere(reference):
    assert link_faults(reference) == []
    pages = " ".join(p.read_text(encoding="utf-8") for p in reference.rglob("*.html"))
    assert 'href="#open_scan"' in pages
    assert (reference / "docs/how-to/python.html").exists()
    assert (reference / "examples/notebooks/liquids.html").exists()
    assert 'href="docs/README.html"' in (reference / "index.html").read_text(encoding="utf-8")


def test_pictures_and_linked_files_are_in_the_folder_of_their_pages(reference):
    """The folder can be moved: it does not depend on files of the machine that made it."""
    for page in reference.rglob("*.html"):
        assert '="file:' not in page.read_text(encoding="utf-8"), page
    assert (reference / "docs/images/demo.png").is_file()
    assert (reference / "examples/scripts/surfaces.py").is_file()


def test_the_gallery_shows_what_its_code_draws(tmp_path, monkeypatch):
    """Into a relative folder, as `make docs` does."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "site" / "docs").mkdir(parents=True)
    code = 'open("out/gallery-x.png", "w").write("picture")'
    block = f'<pre><code class="language-python">{html.escape(code)}</code></pre>'
    page = draw_pictures(block, tmp_path, Path("site"))
    assert '<img alt="simulated" src="gallery-x.png">' in page
    assert (tmp_path / "site" / "docs" / "gallery-x.png").read_text(encoding="utf-8") == "picture"


@pytest.mark.parametrize(
    "link", ["gone.html", "other.html#gone", "#gone", "folder/other.html#here", "file:///etc/hosts"]
)
def test_a_link_that_leads_nowhere_is_found(tmp_path, link):
    (tmp_path / "other.html").write_text('<p id="here">')
    (tmp_path / "page.html").write_text(
        f'<a href="other.html#here"></a><a href="#top"></a><a id="top" href="https://a.b/c"></a><a href="{link}"></a>'
    )
    assert link_faults(tmp_path) == [f"page.html: {link}"]


def test_a_package_without_public_names_has_a_page_for_each_module():
    modules = list(list_modules("polysight_shared"))
    assert {"polysight_shared", "polysight_shared.errors", "polysight_shared.config"} <= set(modules)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path, capsys):
    file = tmp_path / "pages"
    file.write_text("mine", encoding="utf-8")
    with pytest.raises(SystemExit) as exit_info:
        main(["--out", str(file)])
    assert exit_info.value.code == 2
    assert f"{file}: not a folder" in capsys.readouterr().err
    assert file.read_text(encoding="utf-8") == "mine"
