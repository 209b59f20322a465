"""What is said of work that takes long: after some seconds, by lines or by a bar, and only where it is asked for."""

import io
import re
import time

import pytest

from spotcheck import cli
from spotcheck.io import progress


class Terminal(io.StringIO):
    """Standard error of a person."""

    def isatty(self):
        return True


@pytest.fixture
def said(monkeypatch):
    """Where progress is said; work counts as long from its start, and every change is told."""
    monkeypatch.setattr(progress, "SHOW_AFTER_S", -1.0)
    for every in ("REDRAW_S", "LINE_S"):
        monkeypatch.setattr(progress, every, 0.0)

    def on(stream: io.StringIO) -> io.StringIO:
        monkeypatch.setattr("sys.stderr", stream)
        return stream

    return on


def test_the_library_says_nothing(said):
    """Unless it is asked to, and the items are the very object that was given."""
    stream, items = said(io.StringIO()), [1, 2]
    assert progress.track(items, "counting") is items
    with progress.track_steps("judging"):
        progress.begin_step("first", 0.0, 0.5)
        progress.advance("one so far")
    assert stream.getvalue() == ""


def test_lines_without_a_terminal(said):
    """One for each change, and no sign that moves a cursor."""
    stream = said(io.StringIO())
    with progress.shown():
        assert list(progress.track(iter("abc"), "fitting spots", 3)) == ["a", "b", "c"]
    lines = stream.getvalue().splitlines()
    # A beat may say the same once more.
    told = list(dict.fromkeys(line.split(",")[0] for line in lines))
    assert told[-3:] == [f"fitting spots: {k} of 3" for k in (1, 2, 3)]
    assert re.fullmatch(r"fitting spots: 3 of 3, \d\d:\d\d so far, \d\d:\d\d to go", lines[-1])
    assert all(line.strip() for line in lines) and not re.search(r"[\r\x1b]", stream.getvalue())


def test_a_bar_on_a_terminal(said):
    """It is drawn anew on one line, and gone at the end."""
    stream = said(Terminal())
    with progress.shown():
        list(progress.track(range(4), "fitting spots"))
    drawn = stream.getvalue()
    assert "4 of 4" in drawn and "\n" not in drawn
    assert not drawn.split("\r")[-1].strip()


def test_steps(said):
    """Their names with their shares, which never go back, nor beyond the end of the step."""
    stream = said(io.StringIO())
    with progress.shown(), progress.track_steps("judging"):
        progress.begin_step("fit", 0.0, 0.1)
        progress.begin_step("search", 0.1, 0.8)
        for k in range(40):
            progress.advance(f"{k} so far")
        progress.begin_step("again", 0.5, 0.8)
        progress.begin_step("rest", 0.8, 1.0)
    shares = [int(own) for own in re.findall(r"(\d+) %", stream.getvalue())]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 80
    assert "judging, search, 7 so far: " in stream.getvalue()
    # The times of the steps differ too much between datasets to foretell the rest.
    assert "to go" not in stream.getvalue()
    # What is done outside belongs to no steps.
    progress.advance("nothing")


@pytest.mark.parametrize(("stream", "every"), [(io.StringIO, "LINE_S"), (Terminal, "BEAT_S")])
def test_a_long_step_is_alive(said, monkeypatch, stream, every):
    """It is shown again and again, though nothing is said of it, and no more once it is over."""
    written = said(stream())
    with progress.shown():
        for name in ("LINE_S", "BEAT_S"):
            monkeypatch.setattr(progress, name, 0.01 if name == every else 3600.0)
        with progress.track_steps("judging"):
            progress.begin_step("search", 0.0, 1.0)
            before = time.monotonic()
            while written.getvalue().count("search") < 5:
                assert time.monotonic() < before + 10.0, "no beat within ten seconds"
                time.sleep(0.01)
        for _ in progress.track(range(2), "fitting spots"):
            before = time.monotonic()
            while len(re.findall(r"fitting spots: [^f]*0 of 2", written.getvalue())) < 5:
                assert time.monotonic() < before + 10.0, "no beat within ten seconds"
                time.sleep(0.01)
    over = written.getvalue()
    time.sleep(0.05)
    assert written.getvalue() == over


def test_time_to_go_runs_down(said, monkeypatch):
    """While a step lasts, by how long those before took: 10 s for a tenth leave 90 s. It is never more than it was, and
    unknown once it has passed."""
    clock = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    with progress._make_bar("{percentage:.0f} %", "{to_go}", total=1.0, desc="fitting") as bar:
        told = []
        for clock[0], done in ((10.0, 0.1), (40.0, 0.0), (99.0, 0.0), (130.0, 0.0), (140.0, 0.7)):
            bar.update(done)
            told.append(bar.format_dict["to_go"])
    assert told == ["01:30 to go", "01:00 to go", "00:01 to go", "time to go unknown", "00:35 to go"]


def test_short_work_is_not_worth_a_word(said, monkeypatch):
    """What is done within seconds."""
    monkeypatch.setattr(progress, "SHOW_AFTER_S", 60.0)
    stream = said(io.StringIO())
    with progress.shown():
        list(progress.track(range(100), "counting"))
    assert stream.getvalue() == ""


def test_the_command_line_asks_for_it(said, there, monkeypatch):
    """And its results are the same as without."""
    made = []
    for asked in (True, False):
        stream = said(io.StringIO())
        (cli.main if asked else cli.run)(["ingest", "my-frames", "--output", "frames.nc"])
        made.append((there / "frames.nc").read_bytes())
        assert ("reading frames: 18 of 18" in stream.getvalue()) == asked
    assert made[0] == made[1]
