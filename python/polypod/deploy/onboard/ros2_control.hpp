// Messages and interfaces of ROS 2: sensor_msgs/JointState and sensor_msgs/Imu in, command interfaces of ros2_control out.
// Templates over the messages: no header of ROS is included.
#pragma once

#include "policy_loop.hpp"

namespace polypod::ros2 {

template <class Stamp>
double seconds(const Stamp& stamp) {
  return static_cast<double>(stamp.sec) + 1e-9 * static_cast<double>(stamp.nanosec);
}

// The sensors in two messages; joints by their names, in whatever order the message has. An Imu has x, y, z, w, and says
// with orientation_covariance[0] = -1 that it gives no orientation. The older of the two messages tells the time. What
// is absent is not finite, at which the loop damps.
template <class JointState, class Imu>
Sensors read(const Contract& contract, const JointState& joints, const Imu& imu) {
  Sensors sensors;
  sensors.time = std::min(seconds(joints.header.stamp), seconds(imu.header.stamp));
  sensors.joint_pos.assign(contract.joints.size(), kNone);
  sensors.joint_vel.assign(contract.joints.size(), kNone);
  for (std::size_t j = 0; j < contract.joints.size(); ++j)
    for (std::size_t i = 0; i < joints.name.size(); ++i)
      if (joints.name[i] == contract.joints[j].name && i < joints.position.size() && i < joints.velocity.size()) {
        sensors.joint_pos[j] = joints.position[i];
        sensors.joint_vel[j] = joints.velocity[i];
      }
  const auto& q = imu.orientation;
  sensors.quaternion = {q.w, q.x, q.y, q.z};
  if (imu.orientation_covariance[0] == -1.0) sensors.quaternion[0] = kNone;
  const auto& w = imu.angular_velocity;
  sensors.angular_velocity = {w.x, w.y, w.z};
  return sensors;
}

// Calls `set(joint, interface, value)` for the interfaces position, velocity, effort, kp and kd of each joint: hardware
// that takes gains, as drives with a PD loop do.
template <class Set>
void write(const Contract& contract, const Command& command, const Set& set) {
  for (std::size_t j = 0; j < contract.joints.size(); ++j) {
    const std::string& name = contract.joints[j].name;
    set(name, "position", command.q[j]);
    set(name, "velocity", command.dq[j]);
    set(name, "effort", command.tau[j]);
    set(name, "kp", command.kp[j]);
    set(name, "kd", command.kd[j]);
  }
}

// Calls `set(joint, "effort", value)` alone: hardware without gains. Call it at the rate of the controller manager, with
// the newest sensors; the command stays for a control step.
template <class Set>
void write_efforts(const Contract& contract, const Command& command, const Sensors& sensors, const Set& set) {
  const Numbers efforts = command.efforts(sensors.joint_pos, sensors.joint_vel, contract.joints);
  for (std::size_t j = 0; j < contract.joints.size(); ++j)
    set(contract.joints[j].name, "effort", std::isfinite(efforts[j]) ? efforts[j] : 0.0);
}

}  // namespace polypod::ros2
