/* A tank with a pump and an outlet, as an FMU for co-simulation: FMI 2.0 or 3.0, by the macro FMI. SI units.
   build.py writes the description with the same value references, and the functions of the standard that are not used. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { PUMP = 1, INFLOW, LEVEL, OUTFLOW, FULL, AREA, PUMP_FLOW, OUTLET, VARIABLES };

#define HEIGHT 2.3          /* m; the tank overflows above */
#define SUBSTEP 0.01        /* s; the solver's step */

typedef struct {
  double value[VARIABLES];
} Tank;

static Tank *tank_new(void) {
  Tank *tank = calloc(1, sizeof *tank);
  if (tank != NULL) {
    tank->value[LEVEL] = 1.2;
    tank->value[AREA] = 0.5;
    tank->value[PUMP_FLOW] = 0.08;
    tank->value[OUTLET] = 0.03;
  }
  return tank;
}

static void tank_outputs(Tank *tank) {
  double *v = tank->value;
  v[OUTFLOW] = v[OUTLET] * sqrt(v[LEVEL]);
  v[FULL] = v[LEVEL] >= HEIGHT;
}

#ifndef BEFORE_STEP         /* a test of failures defines it */
#define BEFORE_STEP(v, t)
#endif

static int tank_step(Tank *tank, double t, double step) {
  double *v = tank->value;
  long n = lround(ceil(step / SUBSTEP - 1e-9));
  BEFORE_STEP(v, t)
  for (long i = 0; i < n; i++) {
    double flow = v[INFLOW] + (v[PUMP] != 0) * v[PUMP_FLOW] - v[OUTLET] * sqrt(v[LEVEL]);
    v[LEVEL] = fmin(fmax(v[LEVEL] + flow / v[AREA] * step / n, 0), HEIGHT);
  }
  (void)t;
  return 0;
}

#if FMI == 2
#include "fmi2Functions.h"
typedef fmi2ValueReference Reference;
#else
#include "fmi3Functions.h"
typedef fmi3ValueReference Reference;
#endif

#define COPY(n, to, from)                                                                                              \
  for (size_t i = 0; i < (n); i++) {                                                                                   \
    if (reference[i] == 0 || reference[i] >= VARIABLES) return 3;                                                      \
    to = from;                                                                                                         \
  }                                                                                                                    \
  return 0

#if FMI == 2

const char *fmi2GetVersion(void) { return fmi2Version; }
const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
  return type == fmi2CoSimulation && strcmp(guid, TOKEN) == 0 ? tank_new() : NULL;
}
void fmi2FreeInstance(fmi2Component tank) { free(tank); }
fmi2Status fmi2SetupExperiment(fmi2Component tank, fmi2Boolean with_tolerance, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean with_stop, fmi2Real stop) { return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component tank) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component tank) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component tank) { return fmi2OK; }

fmi2Status fmi2GetReal(fmi2Component c, const Reference reference[], size_t n, fmi2Real value[]) {
  tank_outputs(c);
  COPY(n, value[i], ((Tank *)c)->value[reference[i]]);
}
fmi2Status fmi2GetBoolean(fmi2Component c, const Reference reference[], size_t n, fmi2Boolean value[]) {
  tank_outputs(c);
  COPY(n, value[i], ((Tank *)c)->value[reference[i]] != 0);
}
fmi2Status fmi2SetReal(fmi2Component c, const Reference reference[], size_t n, const fmi2Real value[]) {
  COPY(n, ((Tank *)c)->value[reference[i]], value[i]);
}
fmi2Status fmi2SetBoolean(fmi2Component c, const Reference reference[], size_t n, const fmi2Boolean value[]) {
  COPY(n, ((Tank *)c)->value[reference[i]], value[i]);
}
fmi2Status fmi2DoStep(fmi2Component tank, fmi2Real t, fmi2Real step, fmi2Boolean no_way_back) {
  return tank_step(tank, t, step);
}

#else

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const Reference intermediate[], size_t n, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
  return strcmp(token, TOKEN) == 0 ? tank_new() : NULL;
}
void fmi3FreeInstance(fmi3Instance tank) { free(tank); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance tank, fmi3Boolean with_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean with_stop, fmi3Float64 stop) { return fmi3OK; }
fmi3Status fmi3ExitInitializationMode(fmi3Instance tank) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance tank) { return fmi3OK; }

fmi3Status fmi3GetFloat64(fmi3Instance c, const Reference reference[], size_t n, fmi3Float64 value[], size_t values) {
  tank_outputs(c);
  COPY(n, value[i], ((Tank *)c)->value[reference[i]]);
}
fmi3Status fmi3GetBoolean(fmi3Instance c, const Reference reference[], size_t n, fmi3Boolean value[], size_t values) {
  tank_outputs(c);
  COPY(n, value[i], ((Tank *)c)->value[reference[i]] != 0);
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const Reference reference[], size_t n, const fmi3Float64 value[],
                          size_t values) {
  COPY(n, ((Tank *)c)->value[reference[i]], value[i]);
}
fmi3Status fmi3SetBoolean(fmi3Instance c, const Reference reference[], size_t n, const fmi3Boolean value[],
                          size_t values) {
  COPY(n, ((Tank *)c)->value[reference[i]], value[i]);
}
fmi3Status fmi3DoStep(fmi3Instance tank, fmi3Float64 t, fmi3Float64 step, fmi3Boolean no_way_back,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
  *event = *terminate = *early = 0;
  *reached = t + step;
  return tank_step(tank, t, step);
}

#endif
