"""The backend `hybrid`: surrogates where they are trusted, finite elements elsewhere, from which they learn."""
