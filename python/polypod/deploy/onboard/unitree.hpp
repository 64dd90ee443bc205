// Messages of Unitree's SDKs: what a loop reads of a state, and what it writes into a command. Head, level, checksum and
// the release of the robot's own controller are the SDK's business.
//
// unitree_sdk2 (LowState_, LowCmd_ of unitree_go and unitree_hg) has members behind functions, such as
// `state.motor_state()[i].q()`; unitree_legged_sdk (LowState, LowCmd) has plain ones, such as `state.motorState[i].q`.
// Quaternions are w, x, y, z in all of them.
#pragma once

#include "policy_loop.hpp"

namespace polypod::unitree {

// Calls f(motor, joint) for each motor that moves a joint of the policy, in the order of the motors.
template <class F>
void for_each_motor(const Contract& contract, F f) {
  for (std::size_t motor = 0; motor < contract.motor_joints.size(); ++motor) {
    const int joint = contract.motor_joints[motor];
    if (joint < 0) continue;
    f(motor, static_cast<std::size_t>(joint));
  }
}

// The sensors in a message of unitree_sdk2 that came at `time`, s; motors in the order of the contract.
template <class LowState>
Sensors read(const Contract& contract, const LowState& state, double time) {
  Sensors sensors;
  sensors.time = time;
  sensors.joint_pos.assign(contract.joints.size(), kNone);
  sensors.joint_vel.assign(contract.joints.size(), kNone);
  for_each_motor(contract, [&](std::size_t motor, std::size_t joint) {
    sensors.joint_pos[joint] = state.motor_state()[motor].q();
    sensors.joint_vel[joint] = state.motor_state()[motor].dq();
  });
  for (std::size_t i = 0; i < 4; ++i) sensors.quaternion[i] = state.imu_state().quaternion()[i];
  for (std::size_t i = 0; i < 3; ++i) sensors.angular_velocity[i] = state.imu_state().gyroscope()[i];
  return sensors;
}

// Fills the motors of a command of unitree_sdk2; a motor that moves no joint stays as it is.
template <class LowCmd>
void write(const Contract& contract, const Command& command, LowCmd& message) {
  for_each_motor(contract, [&](std::size_t motor, std::size_t joint) {
    auto& to = message.motor_cmd()[motor];
    to.mode() = static_cast<unsigned char>(contract.motor_modes[motor]);
    to.q() = static_cast<float>(command.q[joint]);
    to.dq() = static_cast<float>(command.dq[joint]);
    to.kp() = static_cast<float>(command.kp[joint]);
    to.kd() = static_cast<float>(command.kd[joint]);
    to.tau() = static_cast<float>(command.tau[joint]);
  });
}

// The same of unitree_legged_sdk.
template <class LowState>
Sensors read_legged(const Contract& contract, const LowState& state, double time) {
  Sensors sensors;
  sensors.time = time;
  sensors.joint_pos.assign(contract.joints.size(), kNone);
  sensors.joint_vel.assign(contract.joints.size(), kNone);
  for_each_motor(contract, [&](std::size_t motor, std::size_t joint) {
    sensors.joint_pos[joint] = state.motorState[motor].q;
    sensors.joint_vel[joint] = state.motorState[motor].dq;
  });
  for (std::size_t i = 0; i < 4; ++i) sensors.quaternion[i] = state.imu.quaternion[i];
  for (std::size_t i = 0; i < 3; ++i) sensors.angular_velocity[i] = state.imu.gyroscope[i];
  return sensors;
}

template <class LowCmd>
void write_legged(const Contract& contract, const Command& command, LowCmd& message) {
  for_each_motor(contract, [&](std::size_t motor, std::size_t joint) {
    auto& to = message.motorCmd[motor];
    to.mode = static_cast<unsigned char>(contract.motor_modes[motor]);
    to.q = static_cast<float>(command.q[joint]);
    to.dq = static_cast<float>(command.dq[joint]);
    to.Kp = static_cast<float>(command.kp[joint]);
    to.Kd = static_cast<float>(command.kd[joint]);
    to.tau = static_cast<float>(command.tau[joint]);
  });
}

}  // namespace polypod::unitree
