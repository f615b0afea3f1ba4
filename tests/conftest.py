"""Fixtures that all tests share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.recordings import FOLDER


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, $TAGTRAIL_DATA or ../shared/data beside the clone."""
    if not FOLDER.is_dir():
        pytest.skip(f"no recordings at {FOLDER} (set TAGTRAIL_DATA)")
    return FOLDER
