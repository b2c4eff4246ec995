// The camera of a slot.

const float* V = P.viewmats + 16 * camera; const float* K = P.Ks + 9 * camera;
const float fx = K[0], fy = K[4], cx = K[2], cy = K[5];
const float W = (float)P.width, H = (float)P.height;
const float over_x = @FRUSTUM_MARGIN@f * 0.5f * (W - 2.f * P.overscan_x) - P.overscan_x;
const float over_y = @FRUSTUM_MARGIN@f * 0.5f * (H - 2.f * P.overscan_y) - P.overscan_y;
const float wide_x = over_x > 0.f ? over_x : 0.f, wide_y = over_y > 0.f ? over_y : 0.f;
const float x_low = (-cx - wide_x) / fx, x_high = (W - cx + wide_x) / fx;
const float y_low = (-cy - wide_y) / fy, y_high = (H - cy + wide_y) / fy;
