"""Physics of soft bodies. Knows no robot, no task and no learning."""
