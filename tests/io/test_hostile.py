"""Broken and hostile files end in frames or in one sentence, whatever they hold."""

import pytest

from tests.load import hostile

# Inputs of each kind: some seconds. `python -m tests.load.hostile --inputs 100000` tries more.
COUNT = 60


@pytest.fixture(scope="module")
def tallies(tmp_path_factory) -> dict[str, hostile.Tally]:
    """What became of inputs of each kind."""
    return dict(hostile.tallies(tmp_path_factory.mktemp("hostile"), COUNT))


@pytest.mark.parametrize("kind", ["TIFF", "PNG", "PGM", "manifest.csv", "instrument.yaml", "file names", "log tables"])
def test_nothing_but_frames_or_a_sentence(tallies, kind):
    """No other exception, no hang, no memory out of proportion; and the inputs are neither all good nor all bad."""
    own = tallies[kind]
    assert set(own.ends) == {"read", "refused"}, own.worst
    assert own.ends.total() >= COUNT / 2
