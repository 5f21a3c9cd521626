"""Tests of the page base in a real browser: each control works, and no request leaves the page."""

import base64
import hashlib
import json
import re

import pytest

from bench.pages.html_page import to_embeddable_json
from bench.pages.text_format import format_number
from tests.bench.pages import sample_pages
from tests.browser import REQUIRED, WIDTHS, Opened, launched

CONTROLS = "select:visible, input:visible, canvas:visible, button:not(th button):visible"


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "a page, #1.html"
    file.write_text(sample_pages.page(), encoding="utf-8")
    return file


@pytest.fixture
def opened(browser, path):
    with Opened(browser, path) as one:
        yield one
        assert one.complaints == []


def rows(page, name):
    """Return the displayed cells of a table."""
    return [
        line.locator("td").all_inner_texts() for line in page.locator(f"#{name} tbody tr").all()
    ]


def broken(tmp_path, html):
    file = tmp_path / "broken.html"
    file.write_text(f"<!DOCTYPE html><html lang=en><title>x</title><main>{html}</main>")
    return file


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_complained_of_and_nothing_is_in_the_way(browser, path, width, scheme):
    with Opened(browser, path, width=width, color_scheme=scheme) as one:
        assert one.page.locator("canvas").count() == 3 + 4
        assert one.overflow() <= 0
        assert one.barriers() == []
        assert one.complaints == []


@pytest.mark.parametrize(
    ("html", "complaint"),
    [
        ("<script>console.error('oh')</script>", "console: oh"),
        ("<script>nothing.there()</script>", "script: nothing is not defined"),
        ('<img alt="" src="http://localhost:9/x.png">', "request: http://localhost:9/x.png"),
    ],
)
def test_a_page_that_errs_or_asks_is_noticed(browser, tmp_path, html, complaint):
    with Opened(browser, broken(tmp_path, html)) as one:
        assert complaint in one.complaints


@pytest.mark.parametrize(
    ("html", "rule"),
    [
        ('<img src="data:,">', "image-alt"),
        ("<p style='color:#bbb;background:#fff'>hardly to be read</p>", "color-contrast"),
        ("<select><option>a</option></select>", "select-name"),
    ],
)
def test_what_keeps_people_out_is_noticed(browser, tmp_path, html, rule):
    with Opened(browser, broken(tmp_path, html)) as one:
        assert any(found.startswith(rule) for found in one.barriers())


def test_without_a_browser_the_tests_skip_but_where_it_is_required(monkeypatch):
    monkeypatch.setattr("tests.browser.chromium", lambda: "")
    monkeypatch.delenv(REQUIRED, raising=False)
    with pytest.raises(pytest.skip.Exception, match="apt-get install chromium"), launched():
        pass
    monkeypatch.setenv(REQUIRED, "1")
    with pytest.raises(pytest.fail.Exception, match="apt-get install chromium"), launched():
        pass


def test_texts_are_no_markup(opened):
    assert opened.page.title() == sample_pages.TITLE
    assert opened.page.locator("#broken, #error b, #error h3 i, td i").count() == 0
    assert opened.text("h1") == sample_pages.TITLE
    assert opened.text("#error h3") == "Error <i>now</i>"
    keys = [text.strip() for text in opened.page.locator("#error .key").all_inner_texts()]
    assert keys == list(sample_pages.NAMES)


def test_nothing_in_the_data_ends_the_script_element():
    value = {"</script><!--": ["&lt;", "\u2028", "<"]}
    assert not re.search("[<>&]", to_embeddable_json(value))
    assert json.loads(to_embeddable_json(value)) == value
    with pytest.raises(ValueError, match="JSON compliant"):
        to_embeddable_json(float("nan"))


def test_the_policy_allows_the_pages_script_and_no_other(opened, path):
    html = path.read_text(encoding="utf-8")
    script = re.search(r"<script>(.*)</script>\n</body>", html, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in html
    # The policy blocks an injected script and requests of the page itself.
    opened.page.evaluate(
        "() => { const s = document.createElement('script'); s.textContent = 'window.ran = 1';"
        " document.body.append(s); }"
    )
    assert opened.page.evaluate("window.ran") is None
    asked = "fetch('http://localhost:9/').then(() => 'went', (e) => String(e))"
    assert "Failed to fetch" in opened.page.evaluate(asked)
    assert any("Content Security Policy" in text for text in opened.complaints)
    opened.complaints.clear()


def test_a_series_that_is_switched_off_is_gone_everywhere_and_stays_so(browser, opened, path):
    page = opened.page
    before = page.locator("#error canvas").first.screenshot()
    page.locator("#error .key").first.click()
    assert page.locator("#error .key").first.get_attribute("aria-pressed") == "false"
    assert page.locator("#bins .key").first.get_attribute("aria-pressed") == "false"
    assert page.locator("#error canvas").first.screenshot() != before
    assert "least squares" not in {row[0] for row in rows(page, "numbers")}
    assert opened.text("#numbers .count") == "24 of 64 rows"
    with Opened(browser, path, "#" + page.evaluate("location.hash.slice(1)")) as again:
        assert again.page.locator("#error .key").first.get_attribute("aria-pressed") == "false"
        assert again.page.locator("#error .key[aria-pressed=true]").count() == 3
    page.get_by_role("button", name="all", exact=True).first.click()
    assert page.locator("#error .key[aria-pressed=true]").count() == 4
    assert opened.state() == ""
    page.locator("#error .key").nth(2).click(modifiers=["Shift"])
    on = page.locator("#error .key[aria-pressed=true]").all_inner_texts()
    assert [text.strip() for text in on] == ["random"]


def test_what_nobody_sees_is_drawn_when_it_comes_into_sight(browser, opened):
    page = opened.page
    marked = "all => all.forEach(one => { one.dataset.drawn = 'before'; })"
    left = "#motion canvas[data-drawn]"
    page.locator("canvas").evaluate_all(marked)
    page.locator("#error .key").first.click()
    # The clicked figure is drawn again; a figure far below is drawn when it becomes visible.
    assert page.locator("#error canvas[data-drawn]").count() == 0
    assert page.locator(left).count() == 4
    page.locator("#theme").select_option("dark")
    assert page.locator(left).count() == 4
    page.locator("#motion").scroll_into_view_if_needed()
    page.locator(left).first.wait_for(state="detached")
    # A choice in a figure itself is drawn at once, wherever the page is scrolled.
    page.evaluate("scrollTo(0, 0)")
    page.locator("canvas").evaluate_all(marked)
    page.locator("#motion .key", has_text="hip").dispatch_event("click")
    assert page.locator("#motion canvas").count() == 6
    assert page.locator(left).count() == 0


def test_facets_and_scales_are_chosen_and_kept(browser, opened, path):
    page = opened.page
    assert page.locator("#error .panel").count() == 2
    page.locator("#error").get_by_label("targets").select_option("anywhere")
    assert page.locator("#error .panel h4").all_inner_texts() == ["anywhere"]
    before = page.locator("#error canvas").screenshot()
    page.locator("#error").get_by_label("vertical").select_option("linear")
    assert page.locator("#error canvas").screenshot() != before
    assert set(opened.state().split("&")) == {"error.targets=anywhere", "error.y=linear"}
    with Opened(browser, path, f"#{opened.state()}") as again:
        assert again.page.locator("#error .panel h4").all_inner_texts() == ["anywhere"]
        assert again.page.locator("#error").get_by_label("vertical").input_value() == "linear"


def test_dragging_zooms_and_whole_shows_everything_again(opened):
    page = opened.page
    box = page.locator("#error .u-over").first.bounding_box()
    before = page.locator("#error canvas").first.screenshot()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.2 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 0.7 * box["height"], steps=4)
    page.mouse.up()
    page.wait_for_url(re.compile("zoom"))
    low, high, least, most = map(
        float, re.search(r"error\.zoom=(.*)", opened.state())[1].split(",")
    )
    # 50 % and 90 % of an axis of 2.2 decades with a margin of 4 % at both ends.
    assert (low, high) == (pytest.approx(3.98, rel=0.03), pytest.approx(35.4, rel=0.03))
    assert 1e-4 < least < most < 1
    assert page.locator("#error canvas").first.screenshot() != before
    page.locator("#error").get_by_role("button", name="show everything again").click()
    assert opened.state() == ""
    page.mouse.move(0, 0)
    assert page.locator("#error canvas").first.screenshot() == before


def test_what_stands_at_the_cursor_is_what_the_table_holds(opened):
    page = opened.page
    box = page.locator("#error .u-over").nth(1).bounding_box()
    page.mouse.move(box["x"] + 0.99 * box["width"], box["y"] + 0.5 * box["height"])
    page.locator("#error .tip").nth(1).wait_for()
    shown = page.locator("#error .tip").nth(1).inner_text().replace("\n", " ")
    frame = sample_pages.errors()
    last = frame[(frame["range"] == "wide") & (frame["simulations"] == 50)]
    assert "simulations: 50" in shown
    for _, row in last.iterrows():
        numbers = (
            format_number(row["median"]),
            format_number(row["low"]),
            format_number(row["high"]),
        )
        assert "{} {} ({} to {})".format(row["tuner"], *numbers) in shown


def test_the_keyboard_reads_values_and_zooms(opened):
    page = opened.page
    page.locator("#error .panel").first.focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    frame = sample_pages.errors()
    third = frame[(frame["range"] == "in") & (frame["simulations"] == 2)]
    said = opened.text("#error .told")
    assert said.startswith("inside. simulations: 2. least squares")
    assert all(format_number(value) in said for value in third["median"])
    page.keyboard.press("+")
    assert "error.zoom=" in opened.state()
    page.keyboard.press("0")
    assert opened.state() == ""
    assert page.evaluate("document.activeElement.className") == "panel"


def test_a_table_is_sorted_filtered_and_searched(opened):
    page = opened.page
    shown = rows(page, "numbers")
    frame = sample_pages.errors()
    wide = frame[frame["range"] == "wide"].sort_values("median", kind="stable")
    assert [row[3] for row in shown] == [format_number(value) for value in wide["median"]][:15]
    page.locator("#numbers").get_by_role("button", name="simulations").click()
    assert page.locator("#numbers th").nth(2).get_attribute("aria-sort") == "ascending"
    page.locator("#numbers").get_by_role("button", name="simulations").click()
    assert [row[2] for row in rows(page, "numbers")][:5] == ["50"] * 4 + ["20"]
    page.locator("#numbers").get_by_label("range").select_option("")
    assert opened.text("#numbers .count") == "64 of 64 rows"
    assert len(rows(page, "numbers")) == 15
    page.get_by_role("button", name="show all 64 rows").click()
    assert len(rows(page, "numbers")) == 64
    page.locator("#numbers").get_by_label("search").fill("RANDOM wide")
    assert {tuple(row[:2]) for row in rows(page, "numbers")} == {("random", "wide")}
    assert "numbers.words=RANDOM wide" in opened.state()


def test_numbers_and_odd_texts_are_shown_as_elsewhere(opened):
    shown = rows(opened.page, "notes")
    expected = [
        format_number(v) if v != float("inf") else "∞" for v in sample_pages.notes()["value"]
    ]
    assert [row[1] for row in shown] == expected
    assert shown[0][0].replace("\n", " ") == sample_pages.ODD.replace("\n", " ")


def test_what_is_copied_and_saved_has_every_digit(opened):
    page = opened.page
    opened.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.locator("#numbers").get_by_role("button", name="copy").click()
    page.get_by_role("button", name="copied").wait_for()
    lines = page.evaluate("navigator.clipboard.readText()").splitlines()
    assert lines[0] == "tuner\trange\tsimulations\tmedian"
    frame = sample_pages.errors()
    wide = frame[frame["range"] == "wide"].sort_values("median", kind="stable")
    assert [float(line.split("\t")[3]) for line in lines[1:]] == list(wide["median"])
    saved = opened.saved(page.locator("#numbers").get_by_role("button", name="save as CSV").click)
    assert saved == ("error.csv", frame.to_csv(index=False).encode())
    saved = opened.saved(page.locator("#error .files").get_by_role("button", name="CSV").click)
    assert saved == ("error.csv", frame.to_csv(index=False).encode())


def test_a_figure_is_saved_as_svg_png_and_pdf(opened):
    files, still = opened.page.locator("#error .files"), sample_pages.make_printed_figure()
    for kind, role, begins in (
        ("SVG", "button", b"<?xml"),
        ("PDF", "link", b"%PDF-"),
        ("PNG", "button", b"\x89PNG"),
    ):
        name, content = opened.saved(files.get_by_role(role, name=kind, exact=True).click)
        assert name == f"error.{kind.lower()}"
        assert content.startswith(begins)
        if kind != "PNG":
            assert content == {"SVG": still.image, "PDF": still.pdf}[kind]
    assert opened.complaints == []


def test_the_theme_is_chosen_and_kept(browser, opened, path):
    ground = "getComputedStyle(document.body).backgroundColor"
    assert opened.page.evaluate(ground) == "rgb(255, 255, 255)"
    opened.page.get_by_label("theme").select_option("dark")
    assert opened.page.evaluate(ground) == "rgb(22, 24, 28)"
    with Opened(browser, path, "#theme=dark") as again:
        assert again.page.evaluate(ground) == "rgb(22, 24, 28)"


def test_a_link_to_a_section_keeps_the_view(opened):
    opened.page.get_by_label("theme").select_option("dark")
    opened.page.get_by_role("link", name="The rest").click()
    assert opened.state() == "theme=dark&at=rest"
    assert opened.page.evaluate("document.getElementById('rest').getBoundingClientRect().top < 100")
    assert opened.page.locator("nav a").all_inner_texts() == [
        "Errors",
        "The rest",
        "Odd texts",
        "Joint by joint",
    ]


def test_without_a_script_figures_are_static_and_tables_stand(browser, path):
    with Opened(browser, path, java_script_enabled=False) as one:
        page = one.page
        assert page.locator("#error img.still").is_visible()
        assert page.locator("button, .live *").count() == 0
        assert page.locator("#numbers tbody tr").count() == 15
        name, content = one.saved(page.locator("#error .files").get_by_role("link").click)
        assert (name, content[:5]) == ("error.pdf", b"%PDF-")


def test_on_paper_there_are_printed_figures_and_no_controls(opened):
    opened.page.get_by_label("theme").select_option("dark")
    opened.page.emulate_media(media="print")
    assert opened.page.locator("#error img.still").is_visible()
    assert not opened.page.locator(CONTROLS).count()
    ground = "getComputedStyle(document.body).backgroundColor"
    assert opened.page.evaluate(ground) == "rgb(255, 255, 255)"


def test_panels_are_switched_on_and_off_one_by_one(browser, opened, path):
    page = opened.page
    motion = page.locator("#motion")
    heads = motion.locator(".panel h4")
    shown = [f"{joint}: {y}" for joint in sample_pages.JOINTS[:2] for y in ("q", "left")]
    assert heads.all_inner_texts() == shown
    motion.locator(".switches .key", has_text="hip").click()
    assert len(heads.all_inner_texts()) == 6
    motion.locator(".switches .key", has_text="wrist").click(modifiers=["Shift"])
    assert heads.all_inner_texts() == shown[2:]
    with Opened(browser, path, page.evaluate("location.hash")) as again:
        assert again.page.locator("#motion .panel h4").all_inner_texts() == shown[2:]
    motion.locator(".switches .key", has_text="wrist").click()
    assert "Everything is switched off." in motion.inner_text()
    motion.get_by_role("button", name="all", exact=True).click()
    motion.locator(".switches .key", has_text="hip").click()
    # The state is the initial one, so the address does not contain it.
    assert opened.state() == ""


def test_one_stretch_of_time_is_zoomed_in_every_panel_and_the_vertical_axis_follows(opened):
    page = opened.page
    box = page.locator("#motion .u-over").first.bounding_box()
    page.locator("#motion .u-over").first.scroll_into_view_if_needed()
    box = page.locator("#motion .u-over").first.bounding_box()
    before = page.locator("#motion canvas").nth(3).screenshot()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.6 * box["height"], steps=4)
    page.mouse.up()
    page.wait_for_url(re.compile("zoom"))
    low, high, least, most = re.search(r"motion\.zoom=(.*)", opened.state())[1].split(",")
    # 25 % and 50 % of an axis of 9.9 s with a margin of 4 % at both ends.
    assert float(low) == pytest.approx(2.28, abs=0.1)
    assert float(high) == pytest.approx(4.95, abs=0.1)
    assert (least, most) == ("", "")
    assert page.locator("#motion canvas").nth(3).screenshot() != before


def test_the_tooltip_has_the_values_in_both_units(opened):
    panel = opened.page.locator("#motion .panel").nth(3)
    panel.focus()
    for _ in range(3):
        panel.press("ArrowRight")
    row = sample_pages.motion()[sample_pages.motion()["joint"] == sample_pages.JOINTS[1]].iloc[2]
    expected = (
        f"wrist, <i>left</i>: left. time [s]: 0.2. position {format_number(row['q'])} rad; "
        f"residual {format_number(row['left'])} noises ({format_number(row['left'] / 2)} rad)"
    )
    assert opened.text("#motion .told") == expected


def test_what_bears_one_name_lights_up_together(opened):
    page = opened.page
    page.locator("#joints tbody tr", has_text="wrist").first.hover()
    lit = page.locator("#motion .panel.lit h4").all_inner_texts()
    assert lit == [f"{sample_pages.JOINTS[1]}: {y}" for y in ("q", "left")]
    page.locator("#motion .panel").first.hover()
    assert page.locator("#joints tr.lit td:first-child").all_inner_texts().count("elbow") >= 5
    assert page.locator("#joints tr.found").count() == page.locator("#joints tr.lit").count()
    # The last row comes first because the order is descending.
    assert rows(page, "joints")[0][1] == "9.9"


def test_a_command_is_copied_with_a_click(opened):
    opened.context.grant_permissions(["clipboard-read", "clipboard-write"])
    opened.page.locator(".copying button").click()
    opened.page.locator(".copying").get_by_role("button", name="copied").wait_for()
    assert opened.page.evaluate("navigator.clipboard.readText()") == sample_pages.COMMAND


def test_a_picture_is_the_same_on_the_screen_and_has_its_files(browser, opened, path):
    picture = opened.page.locator("#same")
    assert picture.locator("img.still").is_visible()
    texts = picture.locator(".files button, .files a").all_inner_texts()
    assert texts == ["PDF", "SVG", "PNG", "numbers as CSV (bins)", "numbers as CSV (notes)"]
    name, content = opened.saved(picture.get_by_role("button", name="notes").click)
    assert (name, content) == ("notes.csv", sample_pages.notes().to_csv(index=False).encode())
    # Without JavaScript, a figure that has no static version is not shown.
    with Opened(browser, path, java_script_enabled=False) as one:
        assert one.page.locator("#same img.still").is_visible()
        assert not one.page.locator("#motion").is_visible()
