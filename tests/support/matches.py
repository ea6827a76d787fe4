"""The accepted pairs of matched features."""

from engine.features import Matches


def pairs_of(found: Matches, element: int = 0) -> list[list[int]]:
    """Slots (query, train) of the accepted pairs of one element of the batch."""
    query = found.valid[element].nonzero()[:, 0]
    return [[int(slot), int(found.train_index[element, slot])] for slot in query]
