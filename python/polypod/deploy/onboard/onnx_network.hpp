// A `Network` by onnxruntime's C++ API (https://github.com/microsoft/onnxruntime/releases, or Debian's
// libonnxruntime-dev). Nothing else of the loop needs onnxruntime.
#pragma once

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <string>
#include <vector>

#include "policy_loop.hpp"

namespace polypod {

class OnnxNetwork {
 public:
  // Loads a graph, which must be the one of the contract's SHA-256. Throws Ort::Exception.
  OnnxNetwork(const Contract& contract, const char* file, const std::string& sha256) : contract_(contract) {
#ifndef _WIN32
    // onnxruntime reports its use to its maker unless this is set before it begins
    setenv("ORT_DISABLE_TELEMETRY", "1", 0);
#endif
    env_ = std::make_unique<Ort::Env>(ORT_LOGGING_LEVEL_WARNING, "policy_loop");
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1);
    session_ = std::make_unique<Ort::Session>(*env_, file, options);
    Ort::AllocatorWithDefaultOptions allocator;
    const auto metadata = session_->GetModelMetadata();
    const auto found = metadata.LookupCustomMetadataMapAllocated("polypod_contract_sha256", allocator);
    is_its_graph_ = found && sha256 == found.get();
  }

  // Whether the header's contract is the one of the graph: else a loop must not begin.
  bool is_its_graph() const { return is_its_graph_; }

  // See `polypod::Network`.
  bool operator()(const std::vector<Floats>& inputs, std::vector<Floats>& outputs) {
    std::vector<const char*> names, wanted;
    std::vector<std::vector<int64_t>> shapes;
    for (const auto& input : contract_.inputs) {
      names.push_back(input.name.c_str());
      shapes.push_back({1, static_cast<int64_t>(input.size)});
    }
    for (const auto& output : contract_.outputs) wanted.push_back(output.name.c_str());
    for (const auto& state : contract_.states) {
      names.push_back(state.input.c_str());
      wanted.push_back(state.output.c_str());
      shapes.emplace_back(state.shape.begin(), state.shape.end());
    }
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    std::vector<Ort::Value> values;
    for (std::size_t i = 0; i < inputs.size(); ++i)
      values.push_back(Ort::Value::CreateTensor<float>(memory, const_cast<float*>(inputs[i].data()), inputs[i].size(),
                                                       shapes[i].data(), shapes[i].size()));
    try {
      const Ort::RunOptions options{nullptr};
      auto found = session_->Run(options, names.data(), values.data(), values.size(), wanted.data(), wanted.size());
      for (std::size_t i = 0; i < outputs.size(); ++i) {
        if (found[i].GetTensorTypeAndShapeInfo().GetElementCount() != outputs[i].size()) return false;
        std::copy_n(found[i].GetTensorData<float>(), outputs[i].size(), outputs[i].begin());
      }
    } catch (const Ort::Exception&) {
      return false;
    }
    return true;
  }

 private:
  Contract contract_;
  std::unique_ptr<Ort::Env> env_;
  std::unique_ptr<Ort::Session> session_;
  bool is_its_graph_ = false;
};

}  // namespace polypod
