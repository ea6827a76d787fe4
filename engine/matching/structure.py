"""NCC by structure as well as grey levels, in a window whose highest peak by grey levels was refused.

Another season, year or sun changes grey levels and swaps the brighter side of an edge, but not the position and
direction of edges. The surface is the mean over grey levels and both orientation channels
(:func:`engine.kernels.scores.orientation`). With a surface model the frame is drawn over the ground's relief, and
not on a plane, which takes longer; and of it the part that would lie on the map at an assumed place, which may be
another part than that matched before.

Above its own level, where it costs least, the frame is matched in blocks, in their places and as parts that may
lie a little off them (Fischler and Elschlager 1973, https://doi.org/10.1109/T-C.1973.223602): roofs and hills that
no surface model shows, and wrong angles, move each block by its own amount. Null-hypothesis templates, the frame's
own upside down and mirrored, measure in the same window what chance reaches.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels.peaks import find_peak
from engine.kernels.scores import FloatImage, enhance, orientation
from engine.kernels.sums import counts, share_on_map
from engine.matching.candidates import PeakCandidate, nats
from engine.matching.correlation import COARSER, MIN_SIDE_PX, MIN_VALID_SHARE, Aligned, Correlator
from engine.matching.peak_evidence import candidate_of
from engine.ncc_fft import ncc
from engine.runtime.device import Device, on_host, to_device
from engine.values import Peak, Window
from engine.window import level_crop

_LEVEL = "structure on a level"  # a step
_BLOCKS = 3  # along each side of the frame
_GIVE = 1 / 16  # of a block's side, by which it may lie off its place


def match_structure(correlator: Correlator, found: PeakCandidate, around: Correlator) -> PeakCandidate | None:
    """The candidate of the highest peak by grey levels and structure, on the first level where it suffices.

    The coarsest comes first: it costs least, and a map is often blurrier than its pixels. If none suffices, it is
    that of the own level, where a rival that looks the same scores the same, whatever the pixels' phase.

    Args:
        correlator: of the frame.
        found: the candidate by grey levels, whose hypothesis is examined; the fix names its window.
        around: of the frame with the prior about which the place must stand out.

    Returns:
        PeakCandidate | None: None if the template is nowhere on the map.
    """
    scheduler, last = correlator.query.scheduler, None
    for coarser in reversed(COARSER):
        aligned = _aligned(correlator, found, last, coarser)
        window = None if aligned is None else around.window(aligned)
        if aligned is None or window is None:
            continue
        step, work_px = (_LEVEL, coarser), aligned.work_px(window)
        if last is not None and not scheduler.can_afford({step: work_px}):
            scheduler.note_refusal(step)
            break
        with scheduler.costed(step, work_px), scheduler.stage("structure"):
            last = _Look(correlator, found, aligned, window, coarser).candidate() or last
        if last is not None and last.suffices(correlator.query.risk):
            break
    return last


def _aligned(
    correlator: Correlator, found: PeakCandidate, last: PeakCandidate | None, coarser: int
) -> Aligned | None:
    """The candidate's hypothesis over the relief, so many levels above its own; None if it shows too little.

    The relief is that at the place by a coarser level, else at the prior's.
    """
    own, site = found.aligned, correlator.query.site
    if coarser == 0 and not site.has_surface:
        return own
    level = own.level + coarser
    if coarser and (level >= site.levels or min(own.template.shape) >> coarser < MIN_SIDE_PX):
        return None
    known = last or (found if correlator.query.prior is None else None)
    place = None if known is None else correlator.nadir_px(known.peak, known.aligned)
    rows, columns = (n >> coarser for n in own.template.shape)
    aligned = correlator.align(own.pose, level, place, (rows, columns) if site.has_surface else None)
    return aligned if isinstance(aligned, Aligned) else None


@dataclass(frozen=True, slots=True)
class _Look:
    """A look at every place of a window on one level.

    Attributes:
        correlator: of the frame.
        found: the candidate by grey levels.
        aligned: its hypothesis on the level.
        window: of full-resolution pixels.
        coarser: how many levels that is above the candidate's own.
    """

    correlator: Correlator
    found: PeakCandidate
    aligned: Aligned
    window: Window
    coarser: int

    def candidate(self) -> PeakCandidate | None:
        """The candidate out of every place; None if the frame fits none.

        The null hypotheses, twice as dear as the frame itself, are matched if its own surface promises a fix.
        """
        correlator, aligned = self.correlator, self.aligned
        site, (height, width) = correlator.query.site, aligned.template.shape
        crop = level_crop(site, self.window, aligned.level)
        if crop.width_px < width + 2 or crop.height_px < height + 2:
            return None
        gray, mask = site.gray(crop, aligned.level), site.valid(crop, aligned.level)
        valid = None if mask.all() else mask
        is_on_map = None if valid is None else share_on_map(counts(valid), height, width) >= MIN_VALID_SHARE
        if is_on_map is not None and not is_on_map.any():
            return None
        search = _channels(gray, valid)

        def surfaces(*patches: NDArray[np.uint8]) -> FloatImage:
            templates = np.stack([_channels(patch, None) for patch in patches], axis=1)
            both = by_blocks(search, templates, correlator.query.device, self._blocks)
            if is_on_map is not None:
                # Nodata is 0 in all channels, near their mean, and hardly lowers places mostly on the map.
                both[..., ~is_on_map] = np.nan
            return both

        own = surfaces(aligned.patch.gray)[:, 0]
        seen = self._best(crop, own, None)
        if not seen.promises(correlator.query.risk):
            return seen
        return self._best(crop, own, surfaces(*correlator.nowhere(aligned)))

    @property
    def _blocks(self) -> int:
        """Along each side of the frame."""
        return _BLOCKS if self.coarser else 1

    def _best(self, crop: Window, own: FloatImage, null: FloatImage | None) -> PeakCandidate:
        """The better candidate of blocks in their places and of blocks that give way.

        Args:
            crop: of the level, in which the surfaces begin.
            own: (K, H', W') surfaces of the frame.
            null: (K, T, H', W') of what shows chance; None takes the frame's own, but for its highest.
        """
        rigid = own[0]
        kinds = zip(own, [None] * len(own) if null is None else null, strict=True)
        return max((self._of(crop, *each, rigid) for each in kinds), key=nats)

    def _of(self, crop: Window, own: FloatImage, null: FloatImage | None, rigid: FloatImage) -> PeakCandidate:
        """The candidate of a surface (H', W') by what others (T, H', W') reach; one is that of rigid blocks."""
        correlator, found, aligned = self.correlator, self.found, self.aligned
        own, *others = (each - np.nanmean(each) for each in (own, *([] if null is None else null)))
        peak = find_peak(np.nan_to_num(own, nan=-1.0), exclusion_px=correlator.exclusion_px(aligned.level))
        # Streets run in few directions: elsewhere the frame itself may reach more than when it is mirrored.
        chance = [np.minimum(own, peak.second_score), *others]
        # Where blocks give way the surface is flat: the place is that of the maximum nearby where they do not.
        reach = slack_px(aligned.template.shape, self._blocks) + 2  # a maximum needs two neighbours
        x, y = max(round(peak.x) - reach, 0), max(round(peak.y) - reach, 0)
        near = np.nan_to_num(rigid[y : y + 2 * reach + 1, x : x + 2 * reach + 1], nan=-1.0)
        sharp = find_peak(near, exclusion_px=0.0)
        rival = max(float(np.nanmax(each)) for each in chance)
        if found.by_search and found.peak.score > 0.0:  # only the search knows the rest of the map
            rival = max(rival, found.peak.second_score / found.peak.score * peak.score)
        place = crop.x0 + x + sharp.x, crop.y0 + y + sharp.y
        seen = candidate_of(
            correlator,
            aligned,
            Peak(*place, peak.score, rival, sharp.curvature),
            self.window,
            is_fitted=found.is_fitted,
            tried=found.evidence.tried * (2.0 * self.coarser + 1.0),  # with the surfaces of other levels
            sigma=max(1e-3, *(float(np.nanstd(each, dtype=np.float64)) for each in chance)),
        )
        evidence = replace(seen.evidence, is_tested=null is not None)
        return replace(seen, by_structure=True, evidence=evidence, fix=replace(seen.fix, window=found.fix.window))


def by_blocks(search: FloatImage, templates: FloatImage, device: Device, blocks: int) -> FloatImage:
    """Mean scores of all channels and blocks.

    Args:
        search: (C, H, W) channels of the map.
        templates: (C, T, h, w) likewise.
        device: where they are correlated.
        blocks: along each side.

    Returns:
        (K, T, H-h+1, W-w+1) of blocks in their places and, if they are several, of each at its best within its
        slack.
    """
    (_, height, width), (rows, columns) = search.shape, templates.shape[2:]
    places = height - rows + 1, width - columns + 1
    block = rows // blocks, columns // blocks
    slack = slack_px((rows, columns), blocks)
    box = np.ones((2 * slack + 1, 2 * slack + 1), np.uint8)
    both = np.zeros((2 if slack else 1, templates.shape[1], *places), np.float32)
    for y, x in itertools.product(range(0, blocks * block[0], block[0]), range(0, blocks * block[1], block[1])):
        top, left = max(y - slack, 0), max(x - slack, 0)
        bottom, right = y + block[0] + places[0] - 1 + slack, x + block[1] + places[1] - 1 + slack
        part, own = search[:, top:bottom, left:right], templates[..., y : y + block[0], x : x + block[1]]
        found = on_host(ncc(to_device(part, device), to_device(np.ascontiguousarray(own), device)).mean(0))
        there = np.s_[y - top : y - top + places[0], x - left : x - left + places[1]]
        for t, scores in enumerate(found):
            both[0, t] += scores[there]
            if slack:
                both[1, t] += cv2.dilate(scores, box)[there]
    both /= blocks**2
    return both


def slack_px(shape: tuple[int, ...], blocks: int) -> int:
    """How far so many blocks along each side of a patch of this shape may lie off their places."""
    return max(1, round(_GIVE * min(shape) / blocks)) if blocks > 1 else 0


def _channels(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None) -> FloatImage:
    """Grey levels and both orientation channels, (3, H, W)."""
    return np.concatenate([enhance(gray, valid=valid)[None], orientation(gray, valid=valid)])
