"""Training data: sampling of designs and commands, labelled states, datasets on disk."""
