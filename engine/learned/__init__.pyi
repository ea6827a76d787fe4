"""The public names, for type checkers and for the package itself; `as` makes them public."""

from engine.learned.loading import load_matcher as load_matcher
from engine.learned.pairs import PairMatcher as PairMatcher
