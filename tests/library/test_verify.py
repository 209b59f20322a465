"""How far the gap closes on frames that no step has seen."""

import numpy as np
import pytest

from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.extend import about, closer_account
from spotcheck.discrepancy.look import look_at
from spotcheck.discrepancy.shots import design_of
from spotcheck.discrepancy.verify import verify
from tests.library.small_verdict import SENSOR, frames, ghost, plain, present


def verified(light, *effects, closer: bool, **options):
    """The gap of effects fitted to some frames on others of the same light."""
    shots, base, setting = frames(light, seed=4, **options)
    setting = setting._replace(sensor=SENSOR)
    look = look_at(shots, design_of(shots), base, setting)
    own = account(look, effects)
    near = about(shots, look, own)
    exact = closer_account(near, own) if closer else None
    unseen, _, _ = frames(light, seed=5, **options)
    return verify(look, account(look, ()), [own], unseen, design_of(unseen), exact)


def test_an_edge_is_predicted_at_every_pixel():
    """Blocks blur an edge, little where they are of 2 px as here; a closer look leaves noise: the mean square of n
    blocks scatters by √(2/n), of 4.5 of which one run in 150,000 fails. Both looks see the same noise."""
    full = SENSOR._replace(full_well_e=380.0 / SENSOR.gain_dn_per_e)
    early = present("saturation", 390.0, 0.03)
    blurred, sharp = (verified(plain, early, closer=own, sensor=full) for own in (False, True))
    blocks = np.isfinite(sharp.maps["after"]).sum()
    assert blurred.after > sharp.after + 0.03
    assert abs(sharp.after - sharp.noise_floor) < 4.5 * np.sqrt(2 / blocks)
    assert sharp.before == blurred.before and sharp.closed > 0.995
    assert sharp.parts == pytest.approx((sharp.closed,))


def test_where_nothing_is_sharp_both_looks_agree():
    """A smooth ghost closes as far either way; what is not there closes nothing."""
    blurred, sharp = (
        verified(ghost, present("ghost_reflection", 0.05, 11.0, -4.0), closer=own) for own in (False, True)
    )
    assert sharp.closed == pytest.approx(blurred.closed, abs=0.01) and sharp.closed > 0.98
    nothing = verified(plain, present("ghost_reflection", 0.0, 11.0, -4.0), closer=True)
    assert abs(nothing.after - nothing.before) < 0.05
