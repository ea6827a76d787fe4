"""The last fix of a bridge, which the next one starts from."""

from __future__ import annotations

import hashlib
import mmap
import os
import struct
import time
import zlib
from pathlib import Path

from engine.runtime.cache_folder import cache_folder
from engine.values import Fix, Prior

_MAX_AGE_S = 60.0  # of a position that a bridge may start from
_VALUES = struct.Struct("=dddd16s")  # latitude, longitude, sigma, monotonic time, boot
_RECORD = struct.Struct(f"={_VALUES.size}sI")  # and a checksum: a process may die while writing
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class LastFix:
    """The last fix of a bridge, in memory that outlives the process.

    The file is mapped into memory, so storing a fix never waits for the disk. Times are on the monotonic clock,
    which no receiver adjusts in flight, and are valid until the computer reboots.

    Args:
        path: the file; None, or a folder that cannot be written, shares it with forks of this process only.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._memory, self._boot = _mapped(path), _boot()

    def keep(self, fix: Fix) -> None:
        """Remember a fix that was just given."""
        values = _VALUES.pack(fix.lat_deg, fix.lon_deg, fix.sigma_m, time.monotonic(), self._boot)
        self._memory[:] = _RECORD.pack(values, zlib.crc32(values))

    def prior(self, max_speed_mps: float) -> Prior | None:
        """Where the vehicle can be by now; None if nothing was stored in the last minute."""
        values, checksum = _RECORD.unpack(self._memory[:])
        lat_deg, lon_deg, sigma_m, time_s, boot = _VALUES.unpack(values)
        age_s = time.monotonic() - time_s
        if checksum != zlib.crc32(values) or boot != self._boot or not 0.0 <= age_s <= _MAX_AGE_S:
            return None
        return Prior(lat_deg=lat_deg, lon_deg=lon_deg, sigma_m=sigma_m + max_speed_mps * age_s)


def last_fix_file(*names: object) -> Path:
    """The file in which the bridge of a link over a map stores its last fix."""
    digest = hashlib.sha256("\n".join(map(str, names)).encode()).hexdigest()
    return cache_folder() / f"last-fix-{digest[:16]}"


def _mapped(path: Path | None) -> mmap.mmap:
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
            try:
                os.posix_fallocate(file, 0, _RECORD.size)  # a full disk fails here, not at the first fix
                return mmap.mmap(file, _RECORD.size)
            finally:
                os.close(file)
        except (OSError, ValueError, AttributeError):  # a home that cannot be written must not end the run
            pass
    return mmap.mmap(-1, _RECORD.size)


def _boot() -> bytes:
    """An id of this boot, if the system provides one."""
    try:
        return bytes.fromhex(_BOOT_ID.read_text(encoding="ascii").strip().replace("-", ""))
    except (OSError, ValueError):
        return bytes(16)
