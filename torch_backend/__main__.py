"""`python -m torch_backend`: see `cli`."""

import os
import sys

from .cli import main

if sys.argv[1:2] == ["farm-task"]:
    told = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(told)  # taking torch's modules apart takes longer than a frame, and a farm pays it for every task
sys.exit(main())
