"""Filters that follow vibrations, and filters exchanged in a running loop."""

from lbt_synth.tracking.follower import LineFollower
from lbt_synth.tracking.loop_identifier import LoopIdentifier
from lbt_synth.tracking.switching import SwitchedController, SwitchReport
from lbt_synth.tracking.tracker import Identifier, TrackingController, TrackingUpdate

__all__ = [
    "Identifier",
    "LineFollower",
    "LoopIdentifier",
    "SwitchReport",
    "SwitchedController",
    "TrackingController",
    "TrackingUpdate",
]
