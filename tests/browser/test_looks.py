"""What the tests of the page call a fault: small pages that have one each, and one that has none."""

import pytest

from tests.browser.opening import alone, look, tabbed

GOOD = """<h1>Title</h1><h2>Part</h2><p>σ = 3.1 px; none is infinite, and information is none. None holds.</p>
<div style="overflow-x: auto"><div style="width: 5000px">a wide table</div></div>
<img alt="a spot" src="data:image/gif;base64,R0lGODlhAQABAAAAACw="><svg role="img" aria-label="an arrow"></svg>
<div class="js-plotly-plot" role="img" aria-label="a profile"><svg></svg></div>
<p style="display: none; color: #eee">NaN</p>"""

# Least contrast that a function asks for; the others have no argument.
ARGUMENTS = {"faint": [4.5]}
# By function, pages with a fault, and what must be said of it.
BAD = {
    "overflow": {
        "<div id=wide style='width: 2000px; height: 9px'></div>": "div#wide",
        "<p style='position: relative; left: -90px'>lost</p>": '"lost"',
        "<style>body { overflow-x: hidden }</style><p style='width: 2000px'>cut</p>": '"cut"',
    },
    "unnamed": {
        "<img id=spot alt='' src='data:,'>": "img#spot",
        "<svg id=arrow></svg>": "svg#arrow",
        "<div class=js-plotly-plot aria-label=spot></div>": "js-plotly-plot",
    },
    "headings": {
        "<h1>Title</h1><h3>Deep</h3>": "h3",
        "<h1>One</h1><h1>Two</h1>": '"Two"',
        "<p>text</p>": "no heading",
    },
    "faint": {
        # #777777 on white has 4.48; #767676 has 4.54.
        "<p style='color: #777777; background: white'>soft</p>": "4.48",
        "<p style='opacity: 0.5; background: white'>half</p>": "half",
        "<svg style='background: black'><text y=20 fill='#222'>dark</text></svg>": "dark",
    },
    "leftovers": {
        "<p>σ = NaN px</p>": "NaN",
        "<td>None</td>": "None",
        "<p>above −inf DN</p>": "inf",
        "<button aria-label='undefined frames'>x</button>": "undefined",
        "<svg><text y=20>nan ± nan</text></svg>": "nan",
    },
    "folded": {"<details id=more><summary>more</summary><p>text</p></details>": "details#more"},
    "cut": {"<div style='width: 90px; overflow-x: auto'><p style='width: 200px'>wide</p></div>": "90 of 200"},
    "beyond": {
        "<div class=js-plotly-plot style='width: 90px'><svg width=90><text x=60 y=20>too far</text></svg></div>":
            "too far",
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def opened(chromium):
    """An empty page."""
    with alone(chromium) as own:
        yield own


@pytest.mark.parametrize(("function", "html"), [(function, html) for function, pages in BAD.items() for html in pages])
def test_a_fault_is_seen(opened, function, html):
    """Each by its own function, which says where it is."""
    opened.page.set_content(html)
    arguments = [function, ARGUMENTS.get(function, [])]
    assert BAD[function][html] in opened.page.evaluate("([name, own]) => looks[name](...own).join()", arguments)


def test_a_good_page_has_none(opened):
    """No function complains of it."""
    opened.page.set_content(GOOD)
    for function in ("overflow", "unnamed", "headings", "leftovers", "faint"):
        assert look(opened.page, function, *ARGUMENTS.get(function, [])) == "", function


@pytest.mark.parametrize("grey, contrast", [("#767676", True), ("#777777", False)])
def test_contrast_is_that_of_the_guidelines(opened, grey, contrast):
    """The greys on white on both sides of 4.5 to 1."""
    opened.page.set_content(f"<body style='background: white'><p style='color: {grey}'>grey</p>")
    assert (not opened.page.evaluate("looks.faint(4.5)")) == contrast


def test_a_good_page_is_walked_in_order(opened):
    """Each control once, radio buttons of one name together; a box of text that scrolls is one, too."""
    opened.page.set_content(
        "<a href='#x'>one</a><details><summary>two</summary><a href='#x'>hidden</a></details><button disabled>no"
        "</button><input type=radio name=r checked><input type=radio name=r><select><option>four"
        "</select><p tabindex=0>five</p><div style='width: 90px; overflow-x: auto'><p style='width: 200px'>six</div>"
    )
    steps = tabbed(opened.page)
    assert [step["at"] for step in steps] == [0, 1, 2, 3, 4, 5]
    assert all(step["seen"] for step in steps)


def test_a_wrong_order_and_a_hidden_focus_are_seen(chromium):
    """A control that comes before its turn, and one that takes the focus's ring away."""
    with alone(chromium) as opened:
        opened.page.set_content("<a href='#x' style='outline: none'>one</a><button tabindex=2>two</button>")
        steps = tabbed(opened.page)
    assert [step["at"] for step in steps] == [1, 0]
    assert [step["seen"] for step in steps] == [True, False]


def test_a_fetch_and_an_error_are_heard(chromium, tmp_path):
    """A picture from elsewhere, what a script throws and what it writes to the console."""
    page = tmp_path / "page.html"
    page.write_text(
        "<img src='http://example.org/a.png'><link rel=stylesheet href='https://example.org/a.css'>"
        "<script>console.error('said'); undefined.thrown</script>",
        encoding="utf-8",
    )
    with alone(chromium) as opened:
        opened.page.goto(page.as_uri())
        assert sorted(opened.outside) == ["http://example.org/a.png", "https://example.org/a.css"]
        assert "said" in opened.errors
        assert any("thrown" in line for line in opened.errors)
