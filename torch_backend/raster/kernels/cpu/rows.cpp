// Opens the loop over the rows of hit `l`; the including file closes it. Defines `row`.

            for (unsigned rest = masks[l]; rest; rest &= rest - 1) {
                int row = __builtin_ctz(rest);
