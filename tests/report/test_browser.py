"""The report in a real browser: it shows everything, asks for nothing, and no name in it does anything."""

import pytest

pytest.importorskip("selenium", reason="needs selenium of the dev dependencies")

from analysis import report
from tests.report import artefacts
from tests.report.browser import LOCAL, Browser, missing

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(missing()), reason=f"not installed: {', '.join(missing())}"),
]
WIDTHS = (390, 1280)


@pytest.fixture(scope="module")
def browser():
    one = Browser()
    yield one
    one.quit()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The report of hostile artefacts, alone in a folder of its own, as it would be mailed."""
    root = tmp_path_factory.mktemp("report")
    assert report.main(artefacts.hostile(root)) == 0
    alone = root / "alone" / "report.html"
    alone.parent.mkdir()
    return (root / "out/smoke/report.html").rename(alone)


def external(requests):
    return [url for url in requests if not url.startswith(LOCAL)]


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_logs_nothing_and_asks_the_network_for_nothing(browser, page, width, dark):
    browser.open(page, width, dark)
    assert browser.console() == []
    requests = browser.requests()
    assert page.resolve().as_uri() in requests  # so that the record does record
    assert external(requests) == []
    assert [url for url in requests if url.startswith("file:")] == [page.resolve().as_uri()]


def test_a_request_a_script_and_a_log_would_be_seen(browser, tmp_path):
    bad = tmp_path / "bad.html"
    bad.write_text('<!doctype html><img src="http://127.0.0.1:9/x.png"><script>console.error("seen")</script>')
    browser.open(bad, 1280)
    assert any("seen" in line for line in browser.console())
    assert external(browser.requests()) == ["http://127.0.0.1:9/x.png"]


def test_the_policy_stops_scripts_and_requests_even_where_escaping_would_fail(browser, page, tmp_path):
    injected = (
        '<script>document.title = "owned"</script><img id="spy" src="http://127.0.0.1:9/spy.png" '
        'onerror="document.title = \'owned\'"><b id="styled" style="color: red">x</b>'
    )
    broken = tmp_path / "broken.html"
    broken.write_text(page.read_text().replace("<main>", f"<main>{injected}"))
    browser.open(broken, 1280)
    assert browser.ask("document.title") == "HiPPO reproduction, smoke scale"
    assert browser.ask("document.getElementById('spy').naturalWidth") == 0
    assert browser.ask("getComputedStyle(document.getElementById('styled')).color") != "rgb(255, 0, 0)"
    assert sum("Content Security Policy" in line for line in browser.console()) >= 3


@pytest.mark.parametrize("width", WIDTHS)
def test_every_picture_loads_and_has_a_text_instead(browser, page, width):
    browser.open(page, width)
    pictures = browser.ask("[...document.images].map(i => [i.naturalWidth, i.getBoundingClientRect().width, i.alt])")
    assert [natural for natural, _, _ in pictures] == [800, 1600, 1600, 64]  # fig1, fig3, the gallery, the video
    assert all(shown > 0 and alt for _, shown, alt in pictures)


def test_a_video_plays_from_within_the_page(browser, page):
    browser.open(page, 1280)
    films = browser.ask(
        """Promise.all([...document.querySelectorAll('video')].map(v => new Promise((done, failed) => {
            v.addEventListener('loadeddata', () => done([v.videoWidth, v.duration]));
            v.addEventListener('error', () => failed(v.error.message)); v.load(); v.play(); })))"""
    )
    assert films == [[64, 1.0]]


def test_every_link_leads_to_a_place_on_the_page_and_every_id_is_there_once(browser, page):
    browser.open(page, 1280)
    links = browser.ask("[...document.links].map(a => a.getAttribute('href'))")
    ids = browser.ask("[...document.querySelectorAll('[id]')].map(e => e.id)")
    assert len(links) >= 9
    assert all(link.startswith("#") and link[1:] in ids for link in links)
    assert len(ids) == len(set(ids))


def test_hostile_names_are_text_and_do_nothing(browser, page):
    browser.open(page, 1280)
    text = browser.ask("document.documentElement.textContent")
    for hostile in (artefacts.ATTACK, artefacts.BREAKOUT, artefacts.MARKDOWN_ATTACK):
        assert text.count(hostile) >= 2
    assert browser.ask("document.scripts.length") == 0
    assert browser.ask("document.querySelectorAll('[onerror], img[src=x], iframe, object, form').length") == 0
    assert browser.ask("document.querySelector('#artefact-table1 td strong').textContent") == artefacts.ATTACK


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_never_scrolls_sideways_even_with_everything_unfolded(browser, page, width):
    browser.open(page, width)
    browser.ask("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert browser.ask("document.documentElement.clientWidth") == width
    assert browser.ask("document.documentElement.scrollWidth") == width
    boxes = browser.ask("[...document.querySelectorAll('.scroll')].map(b => b.scrollWidth > b.clientWidth)")
    assert any(boxes)  # a wide table does scroll, within its box
    spill = """[...document.querySelectorAll('main *, header *, nav *, footer *')]
        .filter(e => !e.closest('.scroll') && e.getBoundingClientRect().right > innerWidth + 1).length"""
    assert browser.ask(f"({spill})") == 0


def test_a_wide_table_without_its_box_would_scroll_the_page(browser, page, tmp_path):
    loose = tmp_path / "loose.html"
    loose.write_text(page.read_text().replace('class="scroll', 'class="'))
    browser.open(loose, 390)
    assert browser.ask("document.documentElement.scrollWidth") > 390


@pytest.mark.parametrize("dark", [False, True])
def test_text_stands_out_from_its_background_by_wcag_aa(browser, page, dark):
    browser.open(page, 1280, dark)
    colors = browser.ask(
        """(() => { const s = getComputedStyle(document.documentElement);
        return Object.fromEntries(['page', 'card', 'ink', 'soft', 'accent', 'good', 'good-back', 'bad', 'bad-back',
            'open', 'open-back', 'faint'].map(n => [n, s.getPropertyValue('--' + n).trim()])); })()"""
    )

    def luminance(name):
        channels = [int(colors[name][i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))

    pairs = [(text, back) for text in ("ink", "soft", "accent") for back in ("page", "card")]
    pairs += [("soft", "faint"), ("good", "good-back"), ("bad", "bad-back"), ("open", "open-back")]
    for text, back in pairs:
        dim, bright = sorted((luminance(text), luminance(back)))
        assert (bright + 0.05) / (dim + 0.05) >= 4.5, (text, back)
    assert (luminance("page") < 0.05) == dark


@pytest.mark.parametrize(("width", "shape"), [(390, (400, 900)), (1280, (1600, 500))])
def test_on_a_phone_a_pictures_panels_stack_and_nothing_is_cut(browser, tmp_path, width, shape):
    artefacts.picture(tmp_path / "out/smoke/fig3.png", "fig3: A title")
    artefacts.picture(tmp_path / "out/smoke/fig3.narrow.png", "fig3: A title", size=(400, 900))
    assert report.main(["--runs-dir", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
    browser.open(tmp_path / "out/smoke/report.html", width)
    picture = "document.querySelector('figure img')"
    left, right, high = browser.ask(f"(r => [r.left, r.right, r.height])({picture}.getBoundingClientRect())")
    assert 0 <= left < right <= width
    assert high / (right - left) == pytest.approx(shape[1] / shape[0], rel=0.1)  # padding and border aside
    assert browser.console() == []
