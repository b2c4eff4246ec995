// The loop over one hit's rows; `benchmarks/hot_loop.py` counts here.

            for (unsigned rest = masks[l]; rest; rest &= rest - 1) {
                int row = __builtin_ctz(rest);
