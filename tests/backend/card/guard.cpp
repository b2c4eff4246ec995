// A CUDA card that is not there: what autograd and torch's accelerator layer ask the driver for, answered with a no-op.
// Loaded before torch (pretend_card.py), so that these answers stand before those of libtorch_cpu.
#include <ATen/DeviceAccelerator.h>
#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>

namespace {
constexpr auto CUDA = c10::DeviceType::CUDA;
c10::Device first() { return {CUDA, 0}; }
c10::Stream stream() { return c10::Stream(c10::Stream::DEFAULT, first()); }

struct Guard : c10::impl::NoOpDeviceGuardImpl<CUDA> {
    c10::Device getDevice() const override { return first(); }
    c10::Device exchangeDevice(c10::Device) const override { return first(); }
    c10::Stream getStream(c10::Device) const noexcept override { return stream(); }
    c10::Stream exchangeStream(c10::Stream) const noexcept override { return stream(); }
};
c10::impl::DeviceGuardImplRegistrar registered(CUDA, new Guard);
}  // namespace

namespace at {
struct PretendedHooks : CUDAHooksInterface {
    explicit PretendedHooks(CUDAHooksArgs) {}
    void init() const override {}
    bool hasCUDA() const override { return true; }
    bool isBuilt() const override { return true; }
    bool isAvailable() const override { return true; }
    bool hasPrimaryContext(DeviceIndex) const override { return true; }
    DeviceIndex getCurrentDevice() const override { return 0; }
    DeviceIndex deviceCount() const override { return 1; }
};
REGISTER_CUDA_HOOKS(PretendedHooks)
}  // namespace at

#define SHOWN __attribute__((visibility("default")))
namespace at::accelerator {
SHOWN std::optional<c10::DeviceType> getAccelerator(bool) { return CUDA; }
SHOWN c10::Stream getCurrentStream(c10::DeviceIndex) { return stream(); }
SHOWN c10::DeviceIndex getDeviceIndex() { return 0; }
SHOWN c10::DeviceIndex deviceCount() { return 1; }
}  // namespace at::accelerator

namespace at::detail {
SHOWN const CUDAHooksInterface& getCUDAHooks() {
    static at::PretendedHooks hooks{CUDAHooksArgs{}};
    return hooks;
}
}  // namespace at::detail
