// The part of onnxruntime's C++ interface that `onboard/onnx_network.hpp` uses, without a runtime: tests compile with it
// where onnxruntime's headers are absent.
#pragma once

#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <vector>

enum OrtLoggingLevel { ORT_LOGGING_LEVEL_WARNING };
enum OrtAllocatorType { OrtArenaAllocator };
enum OrtMemType { OrtMemTypeDefault };

namespace Ort {

struct Exception : std::exception {};
struct Env {
  Env(OrtLoggingLevel, const char*) {}
};
struct SessionOptions {
  SessionOptions& SetIntraOpNumThreads(int) { return *this; }
};
struct AllocatorWithDefaultOptions {};
struct AllocatedFree {
  void operator()(char*) const {}
};
using AllocatedStringPtr = std::unique_ptr<char, AllocatedFree>;
struct ModelMetadata {
  AllocatedStringPtr LookupCustomMetadataMapAllocated(const char*, AllocatorWithDefaultOptions&) const { return {}; }
};
struct TensorTypeAndShapeInfo {
  std::size_t GetElementCount() const { return 0; }
};
struct MemoryInfo {
  static MemoryInfo CreateCpu(OrtAllocatorType, OrtMemType) { return {}; }
};
struct Value {
  template <typename T>
  static Value CreateTensor(const MemoryInfo&, T*, std::size_t, const int64_t*, std::size_t) {
    return {};
  }
  template <typename T>
  const T* GetTensorData() const {
    return nullptr;
  }
  TensorTypeAndShapeInfo GetTensorTypeAndShapeInfo() const { return {}; }
};
struct RunOptions {
  explicit RunOptions(std::nullptr_t) {}
};
struct Session {
  Session(const Env&, const char*, const SessionOptions&) {}
  ModelMetadata GetModelMetadata() const { return {}; }
  std::vector<Value> Run(const RunOptions&, const char* const*, const Value*, std::size_t, const char* const*,
                         std::size_t) {
    return {};
  }
};

}  // namespace Ort
