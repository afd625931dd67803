"""Contact of soft bodies: obstacles, self-contact, friction, and the contact energy of a model."""
