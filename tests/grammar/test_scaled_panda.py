"""A Panda with scaled links has no gaps between its links."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morphgen.checks import home_pose
from morphgen.checks.home_pose import check_links_apart
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.kinematics import forward_kinematics

SCALES = [f"scale{i}" for i in range(1, 8)]
SLIT = 1.6e-3
"""The slits of 1 mm between the Panda's own meshes, at a factor of 1.5, metres."""
FACTOR = st.sampled_from([0.5, 1.5]) | st.floats(0.5, 1.5)


def variation(*factors):
    return load_part(
        default_library().manifest("panda_scaled"), dict(zip(SCALES, factors, strict=True))
    ).fragment


@pytest.mark.slow
@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.tuples(*[FACTOR] * 7))
def test_neighbouring_links_stay_in_contact_for_all_scale_factors(factors):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(home_pose, "MAX_GAP", SLIT)
        assert list(check_links_apart(variation(*factors))) == []


def test_unit_scale_factors_give_the_original_panda():
    panda, same = load_part(default_library().manifest("panda")).fragment, variation(*[1] * 7)
    assert (
        panda.links[8].name == "panda_link8"
    )  # a bare frame, whose pose the scaled part's port has
    assert (same.links, same.joints, same.home) == (panda.links[:8], panda.joints[:7], panda.home)


def test_the_offset_between_joint_faces_scales_with_the_link():
    q = np.zeros(7)
    plain, taller = (forward_kinematics(variation(*f), q) for f in ([1] * 7, [1, 1.4] + [1] * 5))
    lifted = taller[3:, :3, 3] - plain[3:, :3, 3]
    assert lifted == pytest.approx(np.tile([0, 0, 0.4 * 0.1925], (len(lifted), 1)))


def test_lengths_masses_and_inertias_scale_at_constant_density():
    plain, other = variation(*[1] * 7), variation(1.2, 0.5, 1.5, 0.8, 1.1, 0.9, 1.3)
    for i, f in enumerate((1.2, 0.5, 1.5, 0.8, 1.1, 0.9, 1.3, 1.0)):
        a, b = plain.links[i].inertial, other.links[i].inertial
        assert b.mass == pytest.approx(f**3 * a.mass)
        assert b.inertia == pytest.approx([f**5 * value for value in a.inertia])
        assert {shape.geometry.scale for shape in other.links[i].visuals} == {(f, f, f)}
