"""The scenes that ship with svkc: functions that return a chain, most with an initial state."""

from typing import Any as _Any

from svkc import _deprecated
from svkc.scenes.figure import BAR_HEIGHT as BAR_HEIGHT, FOLDER as FOLDER, PALM as PALM
from svkc.scenes.high_bar import (
    HALF_GRIP_WIDTH as HALF_GRIP_WIDTH,
    hanging_state as hanging_state,
    high_bar as high_bar,
)


def __getattr__(name: str) -> _Any:
    """Return the object of a deprecated name, with a `DeprecationWarning`."""
    return _deprecated.resolve(f"scenes.{name}")
