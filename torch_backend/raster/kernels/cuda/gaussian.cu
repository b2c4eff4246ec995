// Parameters of Gaussian g.

const float X = P.means[3 * g], Y = P.means[3 * g + 1], Z = P.means[3 * g + 2];
const float qw = P.quats[4 * g], qx = P.quats[4 * g + 1], qy = P.quats[4 * g + 2], qz = P.quats[4 * g + 3];
const float r0 = P.log_scales[3 * g], r1 = P.log_scales[3 * g + 1], r2 = P.log_scales[3 * g + 2];
const float logit = P.logits[g];
const float qmax = smax(smax(fabsf(qw), fabsf(qx)), smax(fabsf(qy), fabsf(qz)));
