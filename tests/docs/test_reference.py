"""`python -m docs.reference` writes the documentation as HTML pages, among them the reference of the Python interface.

Every public name is in the reference with its docstring, and every link leads to an existing place.
"""

import html
import re
from pathlib import Path

import pytest
from docs.reference import ROOMS, build, link_faults, list_modules, main
from docs.site import build_site, draw_pictures

import polysight
from polysight_shared.errors import ConfigError


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    """Folder with the pages of the public functions, and of the packages with the types of their results."""
    out = tmp_path_factory.mktemp("reference")
    packages = ["polysight", "polysight.api"]
    packages += [f"polysight.{package}" for package in ROOMS]
    pages = []
    for package in packages:
        pages += list_modules(package)
    assert pages == packages, "a package that lists its public functions has one page, and its modules have none"
    build([*pages, "polysight_shared"], out)
    build_site(out, run=False)
    return out


def test_every_public_name_is_on_the_page_with_its_docstring(reference):
    page = (reference / "polysight.html").read_text(encoding="utf-8")
    for name in set(polysight.__all__) - {"__version__"}:
        assert f'id="{name}"' in page
    # A parameter, a sentence and the shape of an array in docstrings.
    for text in ("metal_box_mm", "Reference library of the materials", "complex64 [y_mm, x_mm]"):
        assert text in page


def test_types_of_results_are_links_to_their_pages_and_array_types_are_named_as_in_the_code(reference):
    page = (reference / "polysight.html").read_text(encoding="utf-8")
    for link in ("results.html#Verdict", "materials.html#Score", "planning.html#Forecast", "products.html#Rows"):
        assert f'href="polysight/{link}"' in page
    html_tag = r"<[^>]+>"
    text = re.sub(html_tag, "", page)
    assert "X: ArrayLike" in text
    assert "NDArray[float64]" in text
    # The long forms of these types, and a method that scikit-learn adds to its subclasses.
    for internal_name in ("numpy._typing", "numpy.ndarray[", "set_fit_request"):
        assert internal_name not in text


def test_links_between_the_pages_lead_somewhere(reference):
    assert link_faults(reference) == []
    pages = " ".join(path.read_text(encoding="utf-8") for path in reference.rglob("*.html"))
    assert 'href="#open_scan"' in pages
    assert (reference / "docs/how-to/python.html").exists()
    assert (reference / "examples/notebooks/liquids.html").exists()
    assert 'href="docs/README.html"' in (reference / "index.html").read_text(encoding="utf-8")


def test_pictures_and_linked_files_are_in_the_folder_of_their_pages(reference):
    """The folder can be moved to another machine: no page needs a file outside it."""
    for page in reference.rglob("*.html"):
        assert '="file:' not in page.read_text(encoding="utf-8"), page
    assert (reference / "docs/images/demo.png").is_file()
    assert (reference / "examples/scripts/surfaces.py").is_file()


def test_the_gallery_runs_the_code_on_its_page_and_shows_the_picture_that_it_writes(tmp_path, monkeypatch):
    """The pages are written to a relative folder, as by `make docs`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "site" / "docs").mkdir(parents=True)
    code = 'open("out/gallery-x.png", "w").write("picture")'
    code_block = f'<pre><code class="language-python">{html.escape(code)}</code></pre>'
    page = draw_pictures(code_block, tmp_path, Path("site"))
    assert '<img alt="simulated" src="gallery-x.png">' in page
    assert (tmp_path / "site" / "docs" / "gallery-x.png").read_text(encoding="utf-8") == "picture"


@pytest.mark.parametrize(
    "link", ["gone.html", "other.html#gone", "#gone", "folder/other.html#here", "file:///etc/hosts"]
)
def test_a_link_to_a_missing_page_or_place_is_reported_and_valid_links_are_not(tmp_path, link):
    (tmp_path / "other.html").write_text('<p id="here">')
    valid_links = '<a href="other.html#here"></a><a href="#top"></a><a id="top" href="https://a.b/c"></a>'
    (tmp_path / "page.html").write_text(f'{valid_links}<a href="{link}"></a>')
    assert link_faults(tmp_path) == [f"page.html: {link}"]


def test_a_package_without_public_names_has_a_page_for_each_module():
    modules = list(list_modules("polysight_shared"))
    assert {"polysight_shared", "polysight_shared.errors", "polysight_shared.config"} <= set(modules)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path, capsys):
    file = tmp_path / "pages"
    file.write_text("mine", encoding="utf-8")
    with pytest.raises(SystemExit) as exit_info:
        main(["--out", str(file)])
    assert exit_info.value.code == ConfigError.exit_status
    assert f"{file}: not a folder" in capsys.readouterr().err
    assert file.read_text(encoding="utf-8") == "mine"
