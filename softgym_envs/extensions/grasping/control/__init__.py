"""Control of contacts and of coupled fingers."""
