"""Runs the add-on's tests inside a real Blender, with pytest from a folder, because Blender has no pytest.

blender --background --factory-startup --python .ci/blender_tests.py -- FOLDER_WITH_PYTEST [pytest arguments]
"""

import sys

folder, *arguments = sys.argv[sys.argv.index("--") + 1 :]
sys.path.insert(0, folder)

import pytest  # noqa: E402  (from that folder)

sys.exit(int(pytest.main(["-p", "no:cacheprovider", *arguments])))
