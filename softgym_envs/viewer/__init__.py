"""Pictures and recordings of robots. Nothing here is imported by physics, environments or agents unless they draw."""
