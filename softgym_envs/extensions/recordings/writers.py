"""What ``softgym rollout`` can write with this extension."""

from softgym_envs.viewer.moment import EpisodeWriter

PARAVIEW = EpisodeWriter(
    "softgym_envs.extensions.recordings.paraview:ParaviewWriter",
    help="Write a time series for ParaView to this folder.",
    hint="open its .pvd files with ParaView",
)
GLB = EpisodeWriter(
    "softgym_envs.extensions.recordings.gltf:GlbWriter",
    help="Write an animation for Blender and browsers (.glb) to this file.",
    suffix=".glb",
)
