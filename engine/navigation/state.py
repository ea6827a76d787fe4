"""How much a navigator knows of where the vehicle is."""

import enum


class NavigatorState(enum.Enum):
    """How much a navigator knows.

    ``SEARCHING`` before the first fix, ``TRACKING`` where the newest frame gave a fix, ``COASTING`` on dead
    reckoning since the last one, ``LOST`` where that leads nowhere any more.
    """

    SEARCHING = "searching"
    TRACKING = "tracking"
    COASTING = "coasting"
    LOST = "lost"
