"""Calibrate on a video: the same as ``lanebev run VIDEO --camera CAMERA --lane-width 3.7 --out OUT``."""

import sys

from lanebev.app.config import RunConfig
from lanebev.app.run import run
from lanebev.app.summary import summary

if len(sys.argv) != 4:
    sys.exit("usage: python own_video.py VIDEO CAMERA OUT")
video, camera, out = sys.argv[1:]
config = RunConfig(source=video, camera=camera, out=out, lane_width=3.7)
print(summary(run(config), config))
