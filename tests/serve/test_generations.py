"""The page of a scan changes from one generation of products to the next as a whole: it never shows parts of two."""

import json

from tests.support.page.asking import TOKEN
from tests.support.page.chromium import DESK, Browser
from tests.support.page.live_view import serve_folder
from tests.support.products import write_judged_products

from polysight.products import replace_products

RUNS = 2
LONG_RUNS = 20
# The two generations: the verdict, and the seed of the random numbers of the images.
GENERATIONS = (("good", 2), ("none", 5))
# Parts of the products on the page: badges, reasons, patches, scale of the image, and the place that is probed.
PARTS = "['badges', 'reasons', 'rows', 'scale', 'probe-facts'].map(id => document.getElementById(id).innerText)"
# Script that records the parts 20 times a second and at each change of the document.
RECORD = f"""(() => {{
  window.seen = new Set();
  const look = () => window.seen.add(JSON.stringify({PARTS}));
  setInterval(look, 50);
  new MutationObserver(look).observe(document.body, {{ childList: true, subtree: true, characterData: true }});
}})()"""


def test_a_page_never_shows_a_mixture_of_two_generations(browser: Browser, tmp_path, request):
    runs = LONG_RUNS if request.config.getoption("--long") else RUNS
    products = tmp_path / "one" / "products"
    first_level, first_seed = GENERATIONS[0]
    write_judged_products(products, first_level, seed=first_seed)
    (tmp_path / "one" / "program").mkdir()
    with serve_folder(tmp_path, TOKEN) as view:
        browser.visit(f"{view.address}/scan?scan=one#token={TOKEN}", DESK)
        browser.wait("document.querySelector('#scale img')", "the first image")
        # The range of |P| follows from the patches; that of |H| is the same for all scans relative to metal.
        amplitudes = json.dumps(browser.evaluate("document.getElementById('scale').innerText"))
        browser.click("#maps button[value=p_amplitude]")
        browser.wait(f"document.getElementById('scale').innerText !== {amplitudes}", "the image of P")
        parts = browser.evaluate(PARTS)
        complete_states = [parts]
        browser.evaluate("document.querySelector('canvas.imageview').focus()")
        for key, code in (("ArrowRight", 39), ("Enter", 13)):
            browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=key, windowsVirtualKeyCode=code)
        browser.wait("document.getElementById('probe-facts').innerText", "the place")
        complete_states.append(browser.evaluate(PARTS))
        browser.evaluate(RECORD)

        for run in range(1, runs + 1):
            level, seed = GENERATIONS[run % 2]
            with replace_products(products, "s") as new:
                write_judged_products(new, level, seed=seed)
            _, _, _, scale, _ = parts
            scale_text = json.dumps(scale)
            browser.wait(f"document.getElementById('scale').innerText !== {scale_text}", f"generation {run}")
            parts = browser.evaluate(PARTS)
            if parts not in complete_states:
                complete_states.append(parts)
        seen_states = [json.loads(text) for text in browser.evaluate("[...window.seen]")]
        # The page had three states: the first generation without and with a place that is probed, and the second one.
        first_state, _, last_state = complete_states
        # All parts but the probed place differ between the generations.
        for first_part, last_part in zip(first_state[:-1], last_state[:-1], strict=True):
            assert first_part != last_part
        assert [parts for parts in seen_states if parts not in complete_states] == []
