/* {{ comment | join("\n * ") }}
 * duty = {{ name }}_get_voltage(speed, torque) / supply voltage; torque is that of steady motion.
 * When accelerating, add armature * acceleration to it.
 */
#ifndef {{ name | upper }}_FEED_FORWARD_H
#define {{ name | upper }}_FEED_FORWARD_H

static const float {{ name }}_speed[{{ speeds }}] = { {{- speed -}} };
static const float {{ name }}_torque[{{ torques }}] = { {{- torque -}} };

{% for key, rows in tables.items() %}
static const float {{ name }}_{{ key }}[{{ speeds }}][{{ torques }}] = {
{% for row in rows %}
  { {{- row -}} }{{ "" if loop.last else "," }}
{% endfor %}
};

{% endfor %}
static inline int {{ name }}_place(const float *axis, int points, float x, float *share) {
  int k = 0;
  if (x <= axis[0]) { *share = 0.0f; return 0; }
  if (x >= axis[points - 1]) { *share = 1.0f; return points - 2; }
  while (axis[k + 1] < x) k++;
  *share = (x - axis[k]) / (axis[k + 1] - axis[k]);
  return k;
}

static inline float {{ name }}_read(const float table[{{ speeds }}][{{ torques }}], float speed, float torque) {
  float a, b;
  int i = {{ name }}_place({{ name }}_speed, {{ speeds }}, speed, &a);
  int j = {{ name }}_place({{ name }}_torque, {{ torques }}, torque, &b);
  return (1 - a) * ((1 - b) * table[i][j] + b * table[i][j + 1])
       + a * ((1 - b) * table[i + 1][j] + b * table[i + 1][j + 1]);
}

{% for key, what in [
  ("voltage", "Voltage at the driver's output [V]"), ("current", "Current of one motor [A]"),
  ("efficiency", "Power given over power taken [-]"),
] %}
/* {{ what }} for a speed [rad/s] and a torque [N*m] of the joint; clamped to the tables' range. */
static inline float {{ name }}_get_{{ key }}(float speed, float torque) {
  return {{ name }}_read({{ name }}_{{ key }}, speed, torque);
}

{% endfor %}
#endif
