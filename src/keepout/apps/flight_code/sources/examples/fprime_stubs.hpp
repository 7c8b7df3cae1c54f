// Stubs of the little of F Prime that fprime_component.cpp calls, so that it compiles without F Prime.
#ifndef FPRIME_STUBS_HPP
#define FPRIME_STUBS_HPP

#include <cstddef>
#include <cstdint>

extern "C" {
#include "keepout.h"
}

using U8 = std::uint8_t;
using U32 = std::uint32_t;
using I32 = std::int32_t;
using FwSizeType = std::size_t;
using FwIndexType = std::int16_t;

namespace Keepout {

class SteeringComponentBase {
  public:
    virtual ~SteeringComponentBase() = default;

  protected:
    virtual void schedIn_handler(FwIndexType port, U32 context) = 0;
    keepout_estimate navigationGet_out(FwIndexType port);  // with sensors only the first one counts
#if KEEPOUT_SENSORS > 0
    void samplesGet_out(FwIndexType port, keepout_sample* samples);
#endif
    void forceOut_out(FwIndexType port, double x, double y, double z);
    void tlmWrite_GuardStatus(I32 status);
};

}  // namespace Keepout

#endif
