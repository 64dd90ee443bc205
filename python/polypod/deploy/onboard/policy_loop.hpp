// The loop of a policy on a robot, header only, C++17 without other libraries: sensors in, commands of motors out, once
// per control step. It is `policy_loop.py` in C++: same modes, same faults, same numbers to 1e-6.
//
//   polypod deploy write exported/policy_unitree_go2.onnx --out robot
//
// writes this file and robot/contract.hpp, whose `policy::contract()` says all that the loop knows. The graph is run by
// a `Network`: `onnx_network.hpp` is one of onnxruntime. `unitree.hpp` and `ros2_control.hpp` are interfaces of robots.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <functional>
#include <limits>
#include <map>
#include <string>
#include <vector>

namespace polypod {

// Stands for a limit that is absent.
inline constexpr double kNone = std::numeric_limits<double>::infinity();

struct Joint {
  std::string name;
  int column;  // of the action; -1 for a joint that the policy does not move
  double sign, action_scale, default_pos, lower, upper, stiffness, damping, effort_limit;
};

enum class Source {
  measured,
  robot_constant,
  center_of_mass_velocity,
  base_angular_velocity,
  projected_gravity,
  velocity_command,
  joint_position,
  joint_position_minus_default,
  joint_velocity,
  last_action,
  height_scan
};

struct Term {
  std::string name;
  Source source;
  std::size_t size, history;
  std::vector<std::string> inputs;
  double offset, low, high, scale;
  std::vector<double> constant;
};

struct Tensor {
  std::string name;
  std::size_t size;
};

struct State {
  std::string input, output;
  std::vector<std::size_t> shape;
};

// What a file promises and demands, see contract.schema.json.
struct Contract {
  bool is_folded = true;  // sensors to joint targets; else the observation to the action
  std::string robot;
  double control_dt = 0.02;
  std::array<double, 3> base_com{};
  std::vector<Joint> joints;
  std::vector<int> joint_of_column;  // -1 for a column without a joint
  std::vector<Term> terms;
  std::vector<Tensor> inputs, outputs;
  std::vector<State> states;
  std::array<double, 3> command_low{}, command_high{};
  std::size_t num_rays = 0;
  double stale_after = 0.06, max_tilt = 1.0, joint_margin = 0.1, quaternion_tolerance = 0.05, stand_time = 2.0;
  std::vector<double> safe_damping;
  std::vector<int> motor_joints;  // in the maker's order; -1 for a motor that moves no joint
  std::vector<int> motor_modes;
};

using Numbers = std::vector<double>;
using Floats = std::vector<float>;

// What a robot measures; joints in the order of the contract.
struct Sensors {
  double time = 0.0;  // of the measurement, s, on the clock of `Loop::step`
  Numbers joint_pos, joint_vel;
  std::array<double, 4> quaternion{1.0, 0.0, 0.0, 0.0};  // w, x, y, z; base axes to world axes
  std::array<double, 3> angular_velocity{};              // base axes, rad/s
  Numbers linear_velocity;  // of the base link's origin, base axes, m/s; empty without an estimator
  Numbers height_scan;      // m; empty without a map
  std::map<std::string, Numbers> extra;  // inputs that the robot measures under their own names
};

// What the motors hold until the next control step. Effort: tau + kp (q - position) + kd (dq - velocity).
struct Command {
  std::string mode;
  Numbers q, dq, kp, kd, tau;
  std::string fault, detail;  // empty without a fault

  // Efforts within the limits of the joints for an interface without gains, at the rate of the motors.
  Numbers efforts(const Numbers& position, const Numbers& velocity, const std::vector<Joint>& joints) const {
    Numbers found(q.size());
    for (std::size_t j = 0; j < q.size(); ++j) {
      const double pull = kp[j] * (q[j] - position[j]) + kd[j] * (dq[j] - velocity[j]) + tau[j];
      found[j] = std::clamp(pull, -joints[j].effort_limit, joints[j].effort_limit);
    }
    return found;
  }
};

// Runs the graph on the inputs of the contract, then the states, each one robot's; fills the outputs of the contract, then
// the outputs of the states. Returns false where it fails.
using Network = std::function<bool(const std::vector<Floats>& inputs, std::vector<Floats>& outputs)>;

class Loop {
 public:
  Loop(Contract contract, Network network) : contract_(std::move(contract)), network_(std::move(network)) {
    for (const auto& joint : contract_.joints) held_.push_back(joint.default_pos);
    reset();
  }

  const Contract& contract() const { return contract_; }
  // What the graph was last given.
  const std::vector<Floats>& inputs() const { return inputs_; }

  // Forgets what the policy has seen: an episode begins.
  void reset() {
    action_.assign(contract_.joint_of_column.size(), 0.0F);
    memory_.clear();
    for (const auto& state : contract_.states) {
      std::size_t size = 1;
      for (const auto length : state.shape) size *= length;
      memory_.emplace_back(size, 0.0F);
    }
    past_.clear();
  }

  // Moves to the default pose, and clears a fault. If its cause is still there, the next step damps again.
  void stand() {
    mode_ = "stand";
    fault_.clear();
    detail_.clear();
    from_.clear();
    walks_next_ = false;
  }

  // Lets the policy act when the robot stands, or `at_once`. Does nothing in the damping mode without it.
  void walk(bool at_once = false) {
    if (at_once) {
      fault_.clear();
      detail_.clear();
      begin_walk();
    } else if (mode_ == "stand") {
      walks_next_ = true;
    }
  }

  // Lets the robot sink: the operator's stop.
  void damp() {
    mode_ = "damp";
    walks_next_ = false;
  }

  // The command of the next control step: `now` on the clock of `sensors.time`; forward and left velocity, m/s, and yaw
  // rate, rad/s, kept within the contract's ranges.
  Command step(double now, const Sensors& sensors, const std::array<double, 3>& command) {
    Readings read;
    if (!sense(now, sensors, read)) return damped();
    held_ = read["joint_pos"];
    if (mode_ == "damp") return damped();
    Numbers wanted(command.begin(), command.end());
    if (!is_finite(wanted)) return fail("command_not_finite", "the command holds a number that is not finite");
    for (std::size_t i = 0; i < 3; ++i)
      wanted[i] = std::clamp(wanted[i], contract_.command_low[i], contract_.command_high[i]);
    read["velocity_commands"] = wanted;
    if (mode_ == "stand") {
      const Numbers targets = standing(now);
      if (mode_ == "stand") return commanded(targets);
    }
    return walking(read);
  }

  // Joint targets of an action, before the limits.
  Numbers decode(const Floats& actions) const {
    Numbers targets;
    for (const auto& joint : contract_.joints) {
      const double moved = joint.column < 0 ? 0.0 : joint.action_scale * static_cast<double>(actions[joint.column]);
      targets.push_back(joint.default_pos + moved);
    }
    return targets;
  }

  using Readings = std::map<std::string, Numbers>;

  // The observation of readings by name. It remembers past ones for terms with a history.
  Numbers observe(const Readings& read) {
    Numbers values;
    for (const auto& term : contract_.terms) {
      Numbers now = term.constant;
      if (term.source != Source::robot_constant) {
        now = value_of(term, read);
        for (double& number : now) number = std::clamp(number - term.offset, term.low, term.high) * term.scale;
        if (term.history > 1) {
          auto& past = past_[term.name];
          const std::size_t width = now.size();
          if (past.empty())
            for (std::size_t step = 1; step < term.history; ++step) past.insert(past.end(), now.begin(), now.end());
          past.insert(past.end(), now.begin(), now.end());
          now = past;
          past.erase(past.begin(), past.begin() + static_cast<std::ptrdiff_t>(width));
        }
      }
      values.insert(values.end(), now.begin(), now.end());
    }
    return values;
  }

 private:
  static bool is_finite(const Numbers& numbers) {
    return std::all_of(numbers.begin(), numbers.end(), [](double x) { return std::isfinite(x); });
  }
  static bool is_finite(const Floats& numbers) {
    return std::all_of(numbers.begin(), numbers.end(), [](float x) { return std::isfinite(x); });
  }

  Numbers value_of(const Term& term, const Readings& read) const {
    const Numbers& given = read.at(term.inputs.at(0));
    switch (term.source) {
      case Source::center_of_mass_velocity: {
        const Numbers& w = read.at(term.inputs.at(1));
        const auto& r = contract_.base_com;
        return {given[0] + w[1] * r[2] - w[2] * r[1], given[1] + w[2] * r[0] - w[0] * r[2],
                given[2] + w[0] * r[1] - w[1] * r[0]};
      }
      case Source::joint_position:
      case Source::joint_position_minus_default:
      case Source::joint_velocity: {
        const bool is_relative = term.source == Source::joint_position_minus_default;
        Numbers columns;
        for (const int j : contract_.joint_of_column) {
          if (j < 0) {
            columns.push_back(0.0);
            continue;
          }
          const auto& joint = contract_.joints[static_cast<std::size_t>(j)];
          columns.push_back(joint.sign * (given[static_cast<std::size_t>(j)] - (is_relative ? joint.default_pos : 0.0)));
        }
        return columns;
      }
      default:
        return given;
    }
  }

  // Reads the sensors; false after a fault.
  bool sense(double now, const Sensors& sensors, Readings& read) {
    const std::size_t count = contract_.joints.size();
    std::map<std::string, std::size_t> sizes, needed;
    for (const auto& term : contract_.terms)
      for (const auto& name : term.inputs) sizes.emplace(name, term.size / term.history);
    if (contract_.is_folded)
      for (const auto& input : contract_.inputs) sizes[input.name] = input.size;
    read = {{"joint_pos", sensors.joint_pos},
            {"joint_vel", sensors.joint_vel},
            {"quaternion", {sensors.quaternion.begin(), sensors.quaternion.end()}},
            {"base_ang_vel", {sensors.angular_velocity.begin(), sensors.angular_velocity.end()}}};
    needed = {{"joint_pos", count}, {"joint_vel", count}, {"quaternion", 4}, {"base_ang_vel", 3}};
    if (sizes.count("base_lin_vel")) {
      read["base_lin_vel"] = sensors.linear_velocity;
      needed["base_lin_vel"] = 3;
    }
    if (sizes.count("height_scan")) {
      read["height_scan"] = sensors.height_scan;
      needed["height_scan"] = contract_.num_rays;
    }
    for (const auto& [name, values] : sensors.extra)
      if (sizes.count(name) && !needed.count(name)) {
        read[name] = values;
        needed[name] = sizes[name];
      }
    for (const auto& [name, size] : sizes)
      if (!needed.count(name) && name != "projected_gravity" && name != "velocity_commands" && name != "last_action")
        return refuse("sensor_missing", name + " is not measured");
    for (const auto& [name, size] : needed) {
      if (read[name].empty() && (name == "base_lin_vel" || name == "height_scan"))
        return refuse("sensor_missing", name + " is not measured");
      if (read[name].size() != size) return refuse("sensor_size", name + " has another number of numbers");
    }
    if (!std::isfinite(now) || !std::isfinite(sensors.time))
      return refuse("sensor_not_finite", "the time is not finite");
    for (const auto& [name, values] : read)
      if (!is_finite(values)) return refuse("sensor_not_finite", name + " holds a number that is not finite");
    if (std::abs(now - sensors.time) > contract_.stale_after) return refuse("sensor_stale", "the measurement is old");
    auto q = sensors.quaternion;
    const double length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (std::abs(length - 1.0) > contract_.quaternion_tolerance)
      return refuse("quaternion_not_unit", "the quaternion has another length than 1");
    for (double& number : q) number /= length;
    const auto [w, x, y, z] = q;
    read.erase("quaternion");
    const Numbers gravity{-2.0 * (x * z - w * y), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0};
    read["projected_gravity"] = gravity;
    if (std::acos(std::clamp(-gravity[2], -1.0, 1.0)) > contract_.max_tilt) return refuse("tilt", "the base leans");
    for (std::size_t j = 0; j < count; ++j) {
      const auto& joint = contract_.joints[j];
      const double at = sensors.joint_pos[j];
      if (std::max(at - joint.upper, joint.lower - at) > contract_.joint_margin)
        return refuse("joint_limit", joint.name + " is beyond its limit");
    }
    return true;
  }

  Numbers standing(double now) {
    if (from_.empty()) {
      from_ = held_;
      begun_ = now;
    }
    double share = (now - begun_) / contract_.stand_time;
    if (share >= 1.0 && walks_next_) begin_walk();
    share = 0.5 - 0.5 * std::cos(kPi * std::clamp(share, 0.0, 1.0));
    Numbers targets;
    for (std::size_t j = 0; j < held_.size(); ++j)
      targets.push_back(from_[j] + share * (contract_.joints[j].default_pos - from_[j]));
    return targets;
  }

  void begin_walk() {
    mode_ = "walk";
    walks_next_ = false;
    reset();
  }

  Command walking(Readings& read) {
    read["last_action"] = Numbers(action_.begin(), action_.end());
    inputs_.clear();
    if (contract_.is_folded) {
      for (const auto& input : contract_.inputs) inputs_.emplace_back(read[input.name].begin(), read[input.name].end());
    } else {
      const Numbers observation = observe(read);
      inputs_.emplace_back(observation.begin(), observation.end());
    }
    inputs_.insert(inputs_.end(), memory_.begin(), memory_.end());
    std::vector<Floats> outputs;
    for (const auto& output : contract_.outputs) outputs.emplace_back(output.size, 0.0F);
    outputs.insert(outputs.end(), memory_.begin(), memory_.end());
    const auto sizes = outputs;
    bool is_sound = network_(inputs_, outputs) && outputs.size() == sizes.size();
    for (std::size_t i = 0; is_sound && i < outputs.size(); ++i)
      is_sound = outputs[i].size() == sizes[i].size() && is_finite(outputs[i]);
    if (!is_sound) return fail("action_not_finite", "the graph gives a number that is not finite, or another size");
    Numbers targets;
    for (std::size_t i = 0; i < contract_.outputs.size(); ++i) {
      if (contract_.outputs[i].name == "actions") action_ = outputs[i];
      if (contract_.outputs[i].name == "joint_pos_target") targets.assign(outputs[i].begin(), outputs[i].end());
    }
    if (!contract_.is_folded) targets = decode(action_);
    for (std::size_t c = 0; c < action_.size(); ++c)
      if (contract_.joint_of_column[c] < 0) action_[c] = 0.0F;
    std::copy(outputs.begin() + static_cast<std::ptrdiff_t>(contract_.outputs.size()), outputs.end(), memory_.begin());
    return commanded(targets);
  }

  Command commanded(Numbers targets) const {
    const Numbers zeros(targets.size(), 0.0);
    Command command{mode_, targets, zeros, zeros, zeros, zeros, "", ""};
    for (std::size_t j = 0; j < targets.size(); ++j) {
      const auto& joint = contract_.joints[j];
      command.q[j] = std::clamp(targets[j], joint.lower, joint.upper);
      command.kp[j] = joint.stiffness;
      command.kd[j] = joint.damping;
    }
    return command;
  }

  Command damped() const {
    const Numbers zeros(held_.size(), 0.0);
    return {"damp", held_, zeros, zeros, contract_.safe_damping, zeros, fault_, detail_};
  }

  // Damps until `stand` or `walk(true)` is called.
  Command fail(const std::string& fault, const std::string& detail) {
    refuse(fault, detail);
    return damped();
  }

  bool refuse(const std::string& fault, const std::string& detail) {
    damp();
    if (fault_.empty()) {
      fault_ = fault;
      detail_ = detail;
    }
    return false;
  }

  static constexpr double kPi = 3.14159265358979323846;

  Contract contract_;
  Network network_;
  std::string mode_ = "damp", fault_, detail_;
  Floats action_;
  std::vector<Floats> inputs_, memory_;
  std::map<std::string, Numbers> past_;
  Numbers held_, from_;
  double begun_ = 0.0;
  bool walks_next_ = false;
};

}  // namespace polypod
