"""How well a navigator knows the vehicle's position."""

import enum


class NavigatorState(enum.Enum):
    """How well a navigator knows the position.

    ``SEARCHING`` before the first fix, ``TRACKING`` if the newest frame gave a fix, ``COASTING`` on dead reckoning
    since the last fix, ``LOST`` when dead reckoning has become useless.
    """

    SEARCHING = "searching"
    TRACKING = "tracking"
    COASTING = "coasting"
    LOST = "lost"
