"""Every kind of device, by the kind of its readings: the only place that knows them all."""

from __future__ import annotations

from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.height import Planes
from diffeo_calib.sensors.image import Cameras
from diffeo_calib.sensors.range import FixedPoints

KINDS: dict[str, type[Devices]] = {kind.kind: kind for kind in (FixedPoints, Planes, Cameras)}
