"""Runs the add-on's tests inside a real Blender, which has no pytest of its own.

blender --background --factory-startup --python .ci/blender_tests.py -- FOLDER_WITH_PYTEST [pytest arguments]
"""

import sys

folder, *arguments = sys.argv[sys.argv.index("--") + 1 :]
sys.path.insert(0, folder)

import pytest  # noqa: E402  (found in that folder)

sys.exit(int(pytest.main(["-p", "no:cacheprovider", *arguments])))
