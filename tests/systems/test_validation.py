from __future__ import annotations

import math

import pytest

from systems.validation import nearest, require, require_non_negative, require_positive


def test_a_refusal_names_field_value_and_what_is_allowed() -> None:
    require(True, "use", "all", "'all' or 'best'")
    with pytest.raises(ValueError, match=r"^use is 'most': must be 'all' or 'best'$"):
        require(False, "use", "most", "'all' or 'best'")


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, -math.inf])
def test_numbers_out_of_range_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"^rate is .*: must be greater than 0$"):
        require_positive(size=1.0, rate=value)
    with pytest.raises(ValueError, match=r"^rate is .*: must be 0 or greater$"):
        require_non_negative(size=0.0, rate=value)


def test_zero_is_not_positive_but_not_negative_either() -> None:
    require_non_negative(latency=0.0)
    with pytest.raises(ValueError, match="latency is 0"):
        require_positive(latency=0)


def test_a_typing_error_is_answered_with_the_word_that_was_meant() -> None:
    assert nearest("camra", ["camera", "imu"]) == "did you mean 'camera'?"
    assert nearest("id", ["ID", "pose"]) == "did you mean 'ID'?"
    assert nearest("zzz", ["imu", "camera"]) == "known: camera, imu"
    assert nearest("camera", []) == "none is known"
