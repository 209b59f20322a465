"""What the loop found, kept as numbers and taken up again."""

import json

import pytest

from spotcheck.discrepancy.detect import Detection
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.extend import Findings, Size
from spotcheck.discrepancy.look import look_at
from spotcheck.discrepancy.saved import recalled, saved_of
from spotcheck.discrepancy.shots import design_of
from tests.library.small_verdict import LAW, SENSOR, frames, plain, present


def test_fits_are_taken_up_where_they_ended():
    """A well that is full at 570 DN, just below the peak of 600 DN: with the base model's own peak, 90 % of that, a
    level of 570 DN says nothing, and a fit from there leaves it where it is."""
    shots, base, setting = frames(plain, sensor=SENSOR._replace(full_well_e=570.0 / SENSOR.gain_dn_per_e))
    setting = setting._replace(sensor=SENSOR)
    base = base._replace(law=LAW._replace(peak=0.9 * LAW.peak), amplitude=0.9 * base.amplitude)
    design = design_of(shots)
    look = look_at(shots, design, base, setting)
    first = account(look, ())
    own = account(look, [present("saturation", 570.0, 0.03)], look.problem.start._replace(base=LAW))
    assert own.refit.chi2 < 1.2 * look.problem.used.sum()
    rest, size = Detection(0.5, 300, 1.0, {}), Size(0.0, 0.0, 0.0)
    found = Findings(look, first, rest, size, [own], (look, own), rest, size, {}, {}, "named", {})
    again = recalled(json.loads(json.dumps(saved_of(found), allow_nan=False)), shots, design, base, setting)
    kept = again.explanations[0]
    # A fit ends where its next step gains next to nothing.
    assert kept.refit.chi2 == pytest.approx(own.refit.chi2, abs=0.1)
    assert kept.refit.model.present[0].values == pytest.approx(own.refit.model.present[0].values, rel=1e-3)
    assert again.best is not None and again.best[1].refit.model.present[0].values[0] == pytest.approx(570.0, abs=3.0)
