// Loads the parameters of sixteen Gaussians, and evaluates spherical harmonics at their viewing directions.

const float* V = P.view;
float gather[11][16];
auto fetch = FN(const int* id) -> void {
    for (int l = 0; l < 16; l++) {
        long long i = id[l];
        for (int c = 0; c < 3; c++) gather[c][l] = P.means[3 * i + c];
        for (int c = 0; c < 4; c++) gather[3 + c][l] = P.quats[4 * i + c];
        for (int c = 0; c < 3; c++) gather[7 + c][l] = P.log_scales[3 * i + c];
        gather[10][l] = P.logits[i];
    } };
const float cam[3] = {-(V[0] * V[3] + V[4] * V[7] + V[8] * V[11]), -(V[1] * V[3] + V[5] * V[7] + V[9] * V[11]),
                      -(V[2] * V[3] + V[6] * V[7] + V[10] * V[11])};
const int bands = (int)((P.sh_degree + 1) * (P.sh_degree + 1));
// Harmonics Y[k] at unit directions, and their derivatives if dY is given (rows x, y, z of 16).
auto harmonics = FN(F x, F y, F z, F* Y, F (*dY)[16]) -> void {
    Y[0] = (F)@SH_C0@f;
    if (dY) for (int c = 0; c < 3; c++) for (int i = 0; i < bands; i++) dY[c][i] = (F)0.f;
    if (bands < 4) return;
    Y[1] = -@SH_C1@f * y; Y[2] = @SH_C1@f * z; Y[3] = -@SH_C1@f * x;
    if (dY) { dY[1][1] = (F)-@SH_C1@f; dY[2][2] = (F)@SH_C1@f; dY[0][3] = (F)-@SH_C1@f; }
    if (bands < 9) return;
    F xx = x * x, yy = y * y, zz = z * z;
    const float C2[5] = {@SH_C2@}, C3[7] = {@SH_C3@};
    Y[4] = C2[0] * x * y; Y[5] = C2[1] * y * z; Y[6] = C2[2] * (2.f * zz - xx - yy); Y[7] = C2[3] * x * z;
    Y[8] = C2[4] * (xx - yy);
    if (dY) {
        dY[0][4] = C2[0] * y; dY[1][4] = C2[0] * x; dY[1][5] = C2[1] * z; dY[2][5] = C2[1] * y;
        dY[0][6] = -2.f * C2[2] * x; dY[1][6] = -2.f * C2[2] * y; dY[2][6] = 4.f * C2[2] * z;
        dY[0][7] = C2[3] * z; dY[2][7] = C2[3] * x; dY[0][8] = 2.f * C2[4] * x; dY[1][8] = -2.f * C2[4] * y; }
    if (bands < 16) return;
    Y[9] = C3[0] * y * (3.f * xx - yy); Y[10] = C3[1] * x * y * z; Y[11] = C3[2] * y * (4.f * zz - xx - yy);
    Y[12] = C3[3] * z * (2.f * zz - 3.f * xx - 3.f * yy); Y[13] = C3[4] * x * (4.f * zz - xx - yy);
    Y[14] = C3[5] * z * (xx - yy); Y[15] = C3[6] * x * (xx - 3.f * yy);
    if (dY) {
        dY[0][9] = C3[0] * 6.f * x * y; dY[1][9] = C3[0] * 3.f * (xx - yy);
        dY[0][10] = C3[1] * y * z; dY[1][10] = C3[1] * x * z; dY[2][10] = C3[1] * x * y;
        dY[0][11] = C3[2] * -2.f * x * y; dY[1][11] = C3[2] * (4.f * zz - xx - 3.f * yy);
        dY[2][11] = C3[2] * 8.f * y * z;
        dY[0][12] = C3[3] * -6.f * x * z; dY[1][12] = C3[3] * -6.f * y * z;
        dY[2][12] = C3[3] * (6.f * zz - 3.f * xx - 3.f * yy);
        dY[0][13] = C3[4] * (4.f * zz - 3.f * xx - yy); dY[1][13] = C3[4] * -2.f * x * y;
        dY[2][13] = C3[4] * 8.f * x * z;
        dY[0][14] = C3[5] * 2.f * x * z; dY[1][14] = C3[5] * -2.f * y * z; dY[2][14] = C3[5] * (xx - yy);
        dY[0][15] = C3[6] * 3.f * (xx - yy); dY[1][15] = C3[6] * -6.f * x * y; } };
float shv[48][16];
auto fetch_sh = FN(const int* id) -> void {
    for (int l = 0; l < 16; l++) {
        const float* first = P.sh + (long long)id[l] * P.sh_stride;
        const float* rest = P.sh_rest + (long long)id[l] * P.rest_stride;
        for (int i = 0; i < 3; i++) shv[i][l] = first[i];
        for (int i = 3; i < bands * 3; i++) shv[i][l] = rest[i - 3];
    } };
