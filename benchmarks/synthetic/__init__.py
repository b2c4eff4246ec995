"""Synthetic scenes with truth: people who hold still and drift, seen by a handheld camera."""
