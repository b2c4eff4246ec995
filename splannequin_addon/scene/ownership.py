"""What marks a data-block, node or object as ours."""

from __future__ import annotations

TAG = "splannequin"
