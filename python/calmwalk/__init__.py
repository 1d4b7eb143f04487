"""Python side of calmwalk: adapters for potentials, and reading of campaigns."""

from typing import Any

__all__ = ["open"]


def open(location: Any) -> Any:
    """Open a campaign for reading: see :func:`calmwalk.campaign.open_campaign`."""
    from .campaign import open_campaign

    return open_campaign(location)
