// The loop over one hit's rows.

            for (unsigned rest = masks[l]; rest; rest &= rest - 1) {
                int row = __builtin_ctz(rest);
