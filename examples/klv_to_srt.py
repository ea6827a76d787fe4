"""Convert MISB KLV (ST 0601) to a .SRT that scenematch reads; needs klvdata.

    python klv_to_srt.py flight.klv > flight.srt

The camera points down, its top to the nose; for another mount leave out the last line.
"""

import datetime
import pathlib
import sys

import klvdata

begin = None
for number, packet in enumerate(klvdata.StreamParser(pathlib.Path(sys.argv[1]).read_bytes()), 1):
    value = {tag: entry[-1] for tag, entry in packet.MetadataList().items()}
    time = datetime.datetime.fromisoformat(value[2])
    begin = begin or time  # the video's first frame
    hours, rest = divmod((time - begin).total_seconds(), 3600)
    at = f"{int(hours):02}:{int(rest // 60):02}:{rest % 60:06.3f}".replace(".", ",")
    print(f"{number}\n{at} --> {at}\n[latitude: {float(value[13]):.8f}] [longitude: {float(value[14]):.8f}]")
    print(f"[abs_alt: {float(value[15]):.3f}]\n[gb_yaw: {float(value[5]):.3f} gb_pitch: -90.0 gb_roll: 0.0]\n")
