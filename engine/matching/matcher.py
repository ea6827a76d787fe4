"""SceneMatcher: one frame, prior and budget in, a Fix or NoFix out. Keeps no state but step costs."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from engine.budget import Budget, Deadline
from engine.camera import Camera
from engine.errors import EngineError, OptionError
from engine.matching import method_type, refusals
from engine.matching.align import to_gray
from engine.matching.for_reports import Explanation
from engine.matching.ladder import settled
from engine.matching.method import Method
from engine.matching.query import Query
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime import device as devices
from engine.runtime import threads
from engine.runtime import workers as processes
from engine.runtime.scheduler import Scheduler
from engine.runtime.step_costs import Costs
from engine.values import MAX_SIGMA_M, Fix, Frame, NoFix, Prior, Reason, Window
from engine.window import level_crop, level_for

if TYPE_CHECKING:
    from engine.runtime.tensors import torch

_WARMUP_SHARES = (0.25, 0.12)  # of the map's shorter side that a synthetic frame sees
_WARMUP_SIDE_PX = 4096  # of a larger map only a part with this side is used


def _give_back_memory() -> None:
    """Return the warm-up's memory to the system: glibc keeps it otherwise."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)


def _bounded(prior: Prior) -> Prior:
    """The prior, with uncertainty and movement limited to the width of any map."""
    moved = (prior.moved_east_m, prior.moved_north_m)
    east, north = (min(max(v, -MAX_SIGMA_M), MAX_SIGMA_M) for v in moved)
    return replace(prior, sigma_m=min(prior.sigma_m, MAX_SIGMA_M), moved_east_m=east, moved_north_m=north)


class SceneMatcher:
    """Matches single frames against one map with one camera.

    Args:
        site: the map.
        camera: as calibrated, with its distortion; frames are undistorted by a lookup computed once.
        method: "ncc" (needs height and heading), "sift" (needs neither), "auto": NCC if height and heading are
            known, and SIFT if that leaves doubt and time; "learned": networks with the weights of
            ``options.learned``; or your own, a class derived from :class:`engine.matching.method.Method`.
        device: "cpu", "cuda" or "auto".
        options: settings. The accuracy that the map states overrides theirs.

    Raises:
        OptionError: the method or the device has an unknown name, or "learned" has no weights.
        DeviceError: the device was requested by name and is missing.
    """

    def __init__(
        self,
        site: OrthoMap,
        camera: Camera,
        method: str | type[Method] = "ncc",
        device: str | torch.device = "auto",
        options: MatcherOptions | None = None,
    ) -> None:
        self.options = (options or MatcherOptions()).on_map(site)
        kind = method_type(method) if isinstance(method, str) else method
        self.site = site
        self.camera = camera
        self.method = kind.name
        self.device = devices.resolve(device)
        threads.default_threads()
        self._method = kind(site, self.device, self.options)
        self._costs = Costs()
        self._is_warm = False
        # The camera of undistorted pictures; the mount stays.
        self._pinhole = replace(camera, distortion_model="plumb_bob", distortion=np.zeros(5))

    def warmup(
        self, report: Callable[[int, int], None] = lambda done, total: None, *, brief: bool = False
    ) -> None:
        """Do all one-time work before take-off: compile, find the map's features, plan, and measure step costs.

        Features are found on every level of at most :data:`engine.maps.landmarks.PREPARED_PX` pixels; those of a
        map from a file are kept for the next start. The warm-up matches frames drawn from the map.

        Args:
            report: called with the number of loops compiled (or loaded from an earlier cache) and the total.
            brief: for a start in the air: run each step of a frame with a prior once, and no search. Costs are
                then learned from the first frames, of which some may be late.
        """
        if self._method.loops:
            from engine.runtime import jit  # numba takes a while to import

            jit.prepare(self._method.loops, report)
        self._method.prepare()
        shares, rounds = (_WARMUP_SHARES[:1], 1) if brief else (_WARMUP_SHARES, self._method.warmup_rounds)
        for share in shares:
            frame, prior = self._synthetic_frame(share)
            for _ in range(rounds):
                self.locate(frame, prior)
                self._method.warmup(self._query(frame, prior, Deadline(Budget())))
            if not brief:
                self._method.warmup_search(self._query(frame, prior, Deadline(Budget())))
        if self.site.is_searchable and not brief:
            for _ in range(2):  # a step that ran once has no cost yet and would always start
                self._method.warmup_search(self._query(frame, None, Deadline(Budget())))
        self._is_warm = True
        _give_back_memory()
        self.locate(*self._synthetic_frame(_WARMUP_SHARES[0]))  # allocates again what a frame needs

    def _synthetic_frame(self, share: float) -> tuple[Frame, Prior]:
        """The frame of a camera above the map's middle that sees this share of the map's shorter side."""
        site, camera = self.site, self.camera
        side_px = share * min(site.width_px, site.height_px, _WARMUP_SIDE_PX)
        per_px = side_px / max(camera.width_px, camera.height_px)
        level = level_for(1.0, per_px, site.levels)
        size = (round(camera.width_px * per_px), round(camera.height_px * per_px))
        place = site.inner_px
        last = (site.width_px - size[0], site.height_px - size[1])
        x, y = (int(np.clip(v - (n - 1) / 2, 0, end)) for v, n, end in zip(place, size, last, strict=True))
        crop = level_crop(site, Window(x, y, max(1, size[0]), max(1, size[1])), level)
        image = cv2.resize(site.gray(crop, level), (camera.width_px, camera.height_px))
        middle = site.enu_from_pixel(place)
        height_m = per_px * camera.focal_px * site.gsd_m_per_px
        prior = Prior(east_m=float(middle[0]), north_m=float(middle[1]), sigma_m=5.0)
        return Frame(np.asarray(image, np.uint8), 0, height_m, 0.0, 0.0, 0.0), prior

    def twin(self) -> SceneMatcher:
        """An equal matcher with caches of its own, for another thread."""
        return SceneMatcher(self.site, self.camera, type(self._method), self.device, self.options)

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far; after :meth:`warmup` none rises on a small map."""
        return self._method.cache_counters

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """The camera's position when the frame was taken.

        Args:
            frame: of the camera's resolution.
            prior: where the vehicle should be; None searches the whole map.
            budget: how long the answer may take; None sets no limit. A late answer is refused with
                ``Reason.LATE``.

        Raises:
            CalibrationError: the frame is not of the camera's resolution.
        """
        result = self._located(frame, prior, budget or Budget())
        if isinstance(result, NoFix) and result.reason is Reason.LATE and not self._is_warm:
            return replace(result, detail=f"{result.detail}; compiling: call warmup() before take-off")
        return result

    def _located(self, frame: Frame, prior: Prior | None, budget: Budget) -> Fix | NoFix:
        deadline = Deadline(budget, searches=prior is None)
        query = self._query(frame, prior, deadline)
        if query.prior_px is not None and not np.isfinite(query.prior_px).all():
            return refusals.outside(query, self.method)  # nowhere in the map's coordinate system
        if prior is None and not self.site.is_searchable:
            detail = f"the map of {self.site.size_km} is not searched as a whole; a start position is needed"
            return query.refuse(Reason.MAP_TOO_LARGE, detail, self.method)
        result = settled(query, self._method.locate(query))
        query.scheduler.note_answer()
        if isinstance(result, Fix) and not deadline.met:
            detail = "the answer came after the budget"
            result = query.refuse(Reason.LATE, detail, result.method, window=result.window)
        return replace(result, timings=query.timings, looks=tuple(query.looks))

    def locate_many(
        self,
        frames: Sequence[Frame],
        priors: Sequence[Prior | None],
        budget: Budget | None = None,
        *,
        workers: int | None = None,
    ) -> list[Fix | NoFix]:
        """The results of :meth:`locate` for many frames, in order, computed on all cores.

        Forked copies of this process (Linux) share the work and the prepared map. Their caches end with them: call
        :meth:`warmup` before. Frames are matched one by one in this process on a GPU, with a map that is too large
        for memory, or if there is little work.

        Args:
            frames: of the camera's resolution.
            priors: one per frame; None searches the whole map.
            budget: of each frame.
            workers: largest number of processes. None is one per core, or 1 if other Python threads run. A number
                above 1 may fork even then: no other thread may hold a lock that matching needs.

        Raises:
            OptionError: frames and priors differ in number, or this number of workers is impossible.
            CalibrationError: a frame, which is named by its index, is not of the camera's resolution.
            BackendError: a worker ended.
        """
        if len(frames) != len(priors):
            raise OptionError(f"priors: expected one per frame, {len(frames)}, got {len(priors)}")

        def located(index: int) -> Fix | NoFix:
            try:
                return self.locate(frames[index], priors[index], budget)
            except EngineError as error:
                raise type(error)(f"frames[{index}]: {error}") from error
            except Exception as error:
                error.add_note(f"It is of frames[{index}].")
                raise

        return list(processes.in_order(located, len(frames), self._workers(workers)))

    def _workers(self, asked: int | None) -> int:
        """The number of processes that frames are divided among.

        Raises:
            OptionError: the number is impossible.
        """
        if asked is not None and asked < 1:
            raise OptionError(f"workers: expected 1 or more, got {asked}")
        alone = None
        if self.device.type != "cpu":
            alone = f"on {self.device}"
        elif self.site.reads_files:
            alone = f"with {self.site.name}, which is read from its file as it is needed"
        elif not processes.can_fork():
            alone = "here: only Linux forks, and daemonic processes may not"
        if alone is not None and (asked or 1) > 1:
            raise OptionError(f"workers: expected 1 {alone}, got {asked}")
        if alone is not None:
            return 1
        return processes.safe_count() if asked is None else asked

    def explain(self, frame: Frame, window: Window, method: str | None = None) -> Explanation:
        """The correlation surface or the matches of a frame in a window, for reports.

        Args:
            frame: of the camera's resolution.
            window: the searched window, in map pixels.
            method: "ncc", "sift" or "learned"; None takes the matcher's own, and NCC of "auto".

        Raises:
            OptionError: the matcher has no such method.
            CalibrationError: the frame is not of the camera's resolution.
        """
        if method not in (None, self.method, *self._method.parts):
            known = ", ".join(self._method.parts or [self.method])
            raise OptionError(f"method: expected one of this matcher's ({known}), got {method!r}")
        middle_px = np.array([window.x0, window.y0]) + np.array([window.width_px - 1, window.height_px - 1]) / 2.0
        east, north = self.site.enu_from_pixel(middle_px)
        prior = Prior(east_m=float(east), north_m=float(north), sigma_m=0.0)
        query = self._query(frame, prior, Deadline(Budget()))
        return self._method.parts.get(method or self.method, self._method).explain(query, window)

    def _query(self, frame: Frame, prior: Prior | None, deadline: Deadline) -> Query:
        scheduler, known = Scheduler(deadline, self.device, self._costs), self.options
        with scheduler.stage("grey"):
            gray = self.camera.undistort(to_gray(frame))
        prior = None if prior is None else _bounded(prior)
        site, device = self.site, self.device
        return Query(frame, gray, self._pinhole, site, prior, device, scheduler, known.risk, known.errors)
