"""What ``softgym rollout`` can write with this extension."""

from softgym_envs.extensions.recordings.films import FORMATS
from softgym_envs.viewer.moment import EpisodeWriter

_HERE = "softgym_envs.extensions.recordings"
GLB = EpisodeWriter(
    f"{_HERE}.gltf:writer_of",
    help="Write an animation for Blender and browsers (.glb) to this file.",
    suffixes=(".glb",),
)
PARAVIEW = EpisodeWriter(
    f"{_HERE}.paraview:ParaviewWriter",
    help="Write a time series for ParaView to this folder.",
    hint="open its .pvd files with ParaView",
)
RECORD = EpisodeWriter(
    f"{_HERE}.rerun_file:recorder_of",
    help="Write a rerun recording (.rrd) to this file.",
    suffixes=(".rrd",),
    hint="open it with 'softgym view {path}'",
)
VIDEO = EpisodeWriter(
    f"{_HERE}.films:FilmWriter",
    help="Write a film (.mp4, .gif or .webp) to this file.",
    suffixes=FORMATS,
    draws=True,
)
