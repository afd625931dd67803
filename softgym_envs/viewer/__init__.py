"""Images and recordings of robots; other packages import it only when they draw."""
