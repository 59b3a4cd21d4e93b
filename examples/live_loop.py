"""Calibrate live on a camera or a video, frame by frame: ``python live_loop.py drive.mp4 60``."""

import sys

import cv2

import lanebev

if len(sys.argv) != 3:
    sys.exit("usage: python live_loop.py VIDEO DEGREES_OF_VIEW")
video, degrees = cv2.VideoCapture(sys.argv[1]), float(sys.argv[2])
width, height = (int(video.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
session = lanebev.Session(lanebev.Camera.from_fov(degrees, width, height), focal_std=0.05)
while (frame := video.read()[1]) is not None:
    result = session(frame, stamp=video.get(cv2.CAP_PROP_POS_FRAMES) / video.get(cv2.CAP_PROP_FPS))
    pitch, std = float(result.extrinsics.pitch), float(result.std.pitch)
    print(f"{result.status.name} pitch {pitch:.4f} +- {std:.4f} rad; {', '.join(result.reasons)}")
session.save("state.safetensors")
