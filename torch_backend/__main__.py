"""`python -m torch_backend`: see `cli`."""

import os
import sys

from .cli import main

if sys.argv[1:2] == ["farm-task"]:
    exit_code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)  # unloading torch takes longer than a frame, and every farm task would pay for it
sys.exit(main())
