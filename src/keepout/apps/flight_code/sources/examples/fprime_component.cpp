// An example: the step in a component of F Prime (F'), in the handler of a rate group's port.
//
// Compiled against the stubs of this folder only (fprime_stubs.hpp); in a deployment the base class is generated from
// the component's FPP model, whose ports the stubs name.
#include "fprime_stubs.hpp"

extern "C" {
#include "mission_tables.h"
}

namespace Keepout {

class Steering final : public SteeringComponentBase {
  public:
    // Take the image of tables, which must stay where it is; says whether it is good.
    bool configure(const U8* image, FwSizeType size) {
        const bool good =
            keepout_open(image, size, &keepout_mission_layout, keepout_mission_digest, &tables_) == KEEPOUT_IMAGE_GOOD;
        if (good) {
            keepout_mission_with(&tables_, &mission_);
        }
        begun_ = false;
        return good;
    }

  private:
    // Once a control period.
    void schedIn_handler(FwIndexType, U32) override {
        const keepout_estimate estimate = navigationGet_out(0);
        keepout_order order;
#if KEEPOUT_SENSORS > 0
        keepout_sample samples[KEEPOUT_SENSORS];
        keepout_knowledge known;
        samplesGet_out(0, samples);
        if (!begun_) {
            keepout_begin(&mission_, &memory_, &estimate, samples, nullptr);
        }
        keepout_step(&mission_, &memory_, samples, &known, &order);
#else
        if (!begun_) {
            keepout_begin(&mission_, &memory_, &estimate, nullptr);
        }
        keepout_step(&mission_, &memory_, &estimate, &order);
#endif
        begun_ = true;
        forceOut_out(0, order.force[0], order.force[1], order.force[2]);
        tlmWrite_GuardStatus(order.guard_status);
    }

    keepout_tables tables_{};
    keepout_mission mission_{};
    keepout_memory memory_{};
    bool begun_ = false;
};

}  // namespace Keepout
