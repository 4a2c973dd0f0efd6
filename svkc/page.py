"""Deprecated: `svkc.page.show` is `svkc.show`."""

from typing import Any

from svkc import _deprecated


def __getattr__(name: str) -> Any:
    """Return `svkc.show` for `show`, with a `DeprecationWarning`."""
    return _deprecated.resolve(f"page.{name}")
