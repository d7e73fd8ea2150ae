// Distort an image for the projector's lens: Brown's distortion in OpenCV's convention (k1, k2, p1,
// p2, k3), in homogeneous clip coordinates.  Rays with a larger squared slope than `lens_reach` are
// limited to it, since the polynomial is invalid there.  LENS: 1: apply distortion.
uniform vec4 lens;  // focal lengths and principal point, in clip coordinates
uniform float lens_distortion[5];
uniform float lens_reach;

vec3 through_lens(vec3 clip) {
#if !LENS
    return clip;
#else
    if (clip.z <= 0.0) return clip;
    vec2 slope = (clip.xy / clip.z - lens.zw) / lens.xy;
    float k1 = lens_distortion[0], k2 = lens_distortion[1], k3 = lens_distortion[4];
    vec2 p = vec2(lens_distortion[2], lens_distortion[3]);
    slope *= min(1.0, sqrt(lens_reach / max(dot(slope, slope), 1e-12)));
    float r2 = dot(slope, slope);
    float radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    vec2 bent = slope * radial + 2.0 * p * slope.x * slope.y + p.yx * (r2 + 2.0 * slope * slope);
    return vec3((bent * lens.xy + lens.zw) * clip.z, clip.z);
#endif
}
