"""A camera that drives through one world: the same seed gives the same drive, bit for bit."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.render.camera_motion import BodyMotion, LanePath
from lanebev.render.course import Course
from lanebev.render.frame import RenderedFrame
from lanebev.render.scene.camera.lens import Lens
from lanebev.render.scene.light.weather import CLEAR
from lanebev.render.scene.objects.traffic import NUM_VEHICLES
from lanebev.render.scene.places.tunnel import endless
from lanebev.render.scene.sampler import BatchSampler
from lanebev.render.scene.world import Place, Scene, World, sample_world, scene_at
from lanebev.render.views import render_scenes
from lanebev.tensors import join_tensors
from lanebev.types import Extrinsics

_SCENERY_PERIOD = 450.0  # m; bridges, signs and lamps come again
_ONCOMING_PERIOD = 420.0  # m
_COMING, _COMING_TOGETHER, _SLOWEST = -20.0, -28.0, -3.0  # m/s relative to the camera: who is faster comes
_BEHIND = 40.0  # m behind the camera at which things move to the far end


class Drive:
    """A continuous drive: curves with clothoids, crests, lane changes, suspension, bumps, traffic.

    Args:
        seed: seed of all random numbers.
        image_size: (H, W); with a camera, its own image size.
        num_frames: length.
        fps: frames per second.
        camera: the lens; by default an ideal one with 60 degrees of horizontal view.
        mount: pitch, yaw, roll (rad) and height (m) of the camera at rest; random by default.
        speed: m/s.
        motion: factor of all suspension movement.
        curves: largest curvature is this over 300 m.
        hills: factor of the crests; 0 is a flat road.
        lane_changes: whether there are any.
        weather: "any", or "clear" for a clear day.
        kind: kind of road, one of :data:`~lanebev.render.scene.kinds.KINDS`.
        ideal_sensor: leave out blur, noise and compression.

    Attributes:
        times: (N,) s, float64.
        camera: the lens in use.
        course: curvature and elevation of the road.

    Raises:
        ValueError: no frames, or a frame rate or speed that is not positive.
    """

    def __init__(
        self,
        seed: int,
        image_size: tuple[int, int] = (360, 640),
        num_frames: int = 300,
        fps: float = 20.0,
        camera: Camera | None = None,
        *,
        mount: Extrinsics | None = None,
        speed: float = 28.0,
        motion: float = 1.0,
        curves: float = 1.0,
        hills: float = 1.0,
        lane_changes: bool = True,
        weather: str = "any",
        kind: str = "highway",
        ideal_sensor: bool = False,
    ) -> None:
        if num_frames < 1 or not fps > 0 or not speed > 0:
            raise ValueError(
                f"expected num_frames >= 1, fps > 0 and speed > 0, got {num_frames}, {fps} and {speed}"
            )
        if weather not in ("any", "clear"):
            raise ValueError(f"weather: expected 'any' or 'clear', got {weather!r}")
        self.seed, self.speed, self.ideal_sensor = seed, speed, ideal_sensor
        height, width = image_size
        self.camera = (camera or Camera.from_fov(60.0, width, height)).to(dtype=torch.float32)
        self.times = torch.arange(num_frames, dtype=torch.float64) / fps
        sampler = BatchSampler(1, torch.Generator().manual_seed(seed))
        self.world, first_lane = _sample_drive_world(sampler, weather, kind)
        self.world = self.world._replace(tunnel=endless(self.world.tunnel))
        self.start = float(sampler.uniform(0, 2000))
        duration = num_frames / fps
        self.course = Course(sampler, duration * speed, curves, hills)
        street, layout = self.world.street, self.world.layout
        self._path = LanePath(sampler, street, layout, int(first_lane), duration, lane_changes)
        self._body = BodyMotion(sampler, duration, motion, mount)
        self.world = self._without_collisions(self.world)

    def __len__(self) -> int:
        return len(self.times)

    def _ego_lane(self, across: float) -> int:
        layout = self.world.layout
        last = max(int(layout.exists.sum()) - 2, 0)
        lane = int((layout.across[0] <= across).sum()) - 1
        return min(max(lane, 0), last)

    def extrinsics_at(self, time: float) -> Extrinsics:
        """Return the true pose over the road at a time, each (1,)."""
        arc = self.speed * time
        h = 0.01
        slip = (self._path.across(time + h) - self._path.across(time - h)) / (2 * h * self.speed)
        curvature = float(self.course.curvature(torch.tensor(arc, dtype=torch.float64)))
        lean = 0.02 * curvature * self.speed**2 / 9.81
        pitch, yaw, roll, height = self._body.pose(time)
        values = (pitch, yaw - math.atan(slip), roll + lean, height)
        return Extrinsics(*(torch.tensor([v], dtype=torch.float32) for v in values))

    def _without_collisions(self, world: World) -> World:
        """Remove vehicles that the camera would drive through; the rest of a lane moves at one speed."""
        traffic = world.traffic
        lane = torch.tensor([self._ego_lane(a) for a in traffic.across[0, :NUM_VEHICLES].tolist()])
        speed = traffic.speed.clone()
        coming = speed[0, :NUM_VEHICLES] < _COMING
        own = speed[0, lane].clamp(min=_SLOWEST)  # the first few speeds serve as those of the lanes
        speed[0, :NUM_VEHICLES] = torch.where(coming, _COMING_TOGETHER, own)
        valid = traffic.valid.clone()
        for time in torch.arange(0, float(self.times[-1]) + 0.5, 0.5).tolist():
            across = self._path.across(time)
            along = traffic.along[0, :NUM_VEHICLES] + speed[0, :NUM_VEHICLES] * time
            beside = (traffic.across[0, :NUM_VEHICLES] - across).abs() < 2.6
            valid[0, :NUM_VEHICLES] &= ~(beside & (along < 16.0) & (along > -14.0))
        return world._replace(traffic=traffic._replace(speed=speed, valid=valid))

    def _world_at(self, arc: float, time: float) -> World:
        """Return the world with its traffic at this time and its scenery wrapped about the camera."""
        traffic = self.world.traffic
        ahead = traffic.along + traffic.speed * time  # distance ahead of the camera
        oncoming, still = traffic.speed < _COMING, traffic.speed == 0
        ahead = torch.where(oncoming, (ahead + _BEHIND) % _ONCOMING_PERIOD - _BEHIND, ahead)
        ahead = torch.where(still, (traffic.along - arc + _BEHIND) % _SCENERY_PERIOD - _BEHIND, ahead)
        begin, end = self.world.bridge.unbind(1)
        shift = ((0.5 * (begin + end) - arc + _BEHIND) % _SCENERY_PERIOD - _BEHIND) - 0.5 * (end - begin)
        shift = torch.where(begin.isfinite(), shift, math.inf) + self.start + arc
        traffic = traffic._replace(along=ahead + self.start + arc)
        bridge = torch.stack([shift, shift + torch.where(begin.isfinite(), end - begin, 0.0)], dim=1)
        return self.world._replace(traffic=traffic, bridge=bridge)

    def _scene_at(self, index: int) -> Scene:
        if not 0 <= index < len(self):
            raise IndexError(f"index: expected 0..{len(self) - 1}, got {index}")
        time = float(self.times[index])
        arc, across = self.speed * time, self._path.across(time)
        place = Place(
            along=torch.tensor([self.start + arc]),
            across=torch.tensor([across]),
            ego_lane=torch.tensor([self._ego_lane(across)]),
            heading=torch.tensor([self.course.heading(arc)]),
        )
        camera = self.camera
        lens = Lens(camera.intrinsics[None], camera.distortion[None], camera.model, self.extrinsics_at(time))
        return scene_at(self._world_at(arc, time), place, self.course.alignment(arc), lens)

    def frame(self, index: int, *, device: torch.device | str | None = None) -> RenderedFrame:
        """Render one frame with its truth, B = 1; frames can be asked for in any order.

        Args:
            index: number of the frame.
            device: where to render, and where the result is; by default the CPU.

        Raises:
            IndexError: there is no such frame.
        """
        return self.frames([index], device=device)

    @torch.no_grad()
    def frames(
        self, indices: Sequence[int], *, device: torch.device | str | None = None, rows: int | None = None
    ) -> RenderedFrame:
        """Render frames with their truth, B of them; each is the same whichever are asked for with it.

        Args:
            indices: numbers of the frames, at least one.
            device: where to render, and where the result is; by default the CPU.
            rows: how many are rendered together, see :func:`~lanebev.render.views.render_scenes`.

        Raises:
            IndexError: there is no such frame.
        """
        scenes = join_tensors(torch.cat, [self._scene_at(index) for index in indices])
        seeds = [self.seed * 1_000_003 + index for index in indices]
        size = self.camera.image_size
        return render_scenes(scenes, size, seeds, device=device, rows=rows, ideal_sensor=self.ideal_sensor)


def _sample_drive_world(sampler: BatchSampler, weather: str, kind: str) -> tuple[World, Tensor]:
    """Sample a world for a drive: any, or the first one on a clear day."""
    while True:
        world, lane = sample_world(sampler, kind)
        if weather == "any" or int(world.weather.kind) == CLEAR:
            return world, lane
