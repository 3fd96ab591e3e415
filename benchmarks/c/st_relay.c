/* The logic of profiles/systems/relay.st in C: plain statements over static variables, as a compiler of Structured Text writes them.
 *
 *   st_relay SCANS EVERY     one response of 16 bytes in each EVERYth scan (0: none), after a command in the first scan
 *
 * prints the seconds of CPU time, the number of entries in the log, the dropped ones, and the last entry.
 */
#include <inttypes.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define QUEUE 256
#define KEPT 1024
#define CYCLE_NS 10000000LL

struct text {
  int length;
  char bytes[256];
};
struct entry {
  int length;
  char bytes[1024];
};
struct box {
  int room, most, sent; /* how many messages fit, the longest message, and how many were sent in this scan */
  struct entry messages[64];
};

static struct text command, sample, outgoing[QUEUE];
static struct entry entries[KEPT];
static int64_t times[KEPT], now;
static int commands_in, samples_in, state, first;
static int16_t period, period_s, waiting;
static int32_t commands, responses, logged, bad_commands, dropped, log_sent, lost;
static struct box response = {.most = 256}, data_log = {.most = 1024};

static void log_data(const char *kind, const struct text *data) {
  static const char digits[] = "0123456789abcdef";
  struct entry *entry = &entries[logged % KEPT];
  int n = snprintf(entry->bytes, sizeof entry->bytes, "{\"t_ns\": %" PRId64 ", \"kind\": \"%s\", \"data\": \"", now, kind);
  for (int i = 0; i < data->length && n < 1020; i++) {
    entry->bytes[n++] = digits[(uint8_t)data->bytes[i] >> 4];
    entry->bytes[n++] = digits[(uint8_t)data->bytes[i] & 15];
  }
  entry->bytes[n++] = '"';
  entry->bytes[n++] = '}';
  entry->length = n;
  times[logged % KEPT] = now;
  logged++;
}

static int push(struct box *box, const char *bytes, int length) {
  if (box->sent >= box->room) return 0;
  box->messages[box->sent].length = length;
  memcpy(box->messages[box->sent].bytes, bytes, (size_t)length);
  box->sent++;
  return 1;
}

__attribute__((noinline)) static void scan(void) {
  for (int i = 0; i < commands_in; i++) {
    if (command.length == 2) {
      period = (int16_t)((uint8_t)command.bytes[0] << 8 | (uint8_t)command.bytes[1]);
      state = period > 0 ? 1 : period < 0 ? 2 : 0;
      commands++;
      if (period > 0) log_data("command", &command);
    } else {
      bad_commands++;
      if (period > 0) log_data("bad command", &command);
    }
  }
  for (int i = 0; i < samples_in; i++) {
    responses++;
    if (waiting == QUEUE) {
      first = (first + 1) % QUEUE;
      waiting--;
      lost++;
    }
    outgoing[(first + waiting) % QUEUE] = sample;
    waiting++;
    if (period > 0) log_data("response", &sample);
  }
  while (waiting > 0) {
    if (outgoing[first].length > response.most) lost++;
    else if (!push(&response, outgoing[first].bytes, outgoing[first].length)) break;
    first = (first + 1) % QUEUE;
    waiting--;
  }
  if (log_sent < logged - KEPT) {
    lost += logged - KEPT - log_sent;
    log_sent = logged - KEPT;
  }
  while (log_sent < logged && data_log.room > data_log.sent) {
    const struct entry *entry = &entries[log_sent % KEPT];
    if (entry->length > data_log.most) lost++;
    else push(&data_log, entry->bytes, entry->length);
    log_sent++;
  }
  period_s = period;
  dropped = lost;
}

int main(int argc, char **argv) {
  long scans = atol(argv[1]), every = argc > 2 ? atol(argv[2]) : 0;
  struct timespec a, b;
  struct entry last = {0};
  memcpy(sample.bytes, "0123456789abcdef", 16);
  sample.length = 16;
  command.bytes[1] = 1;
  command.length = 2;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &a);
  for (long n = 1; n <= scans; n++) {
    now = n * CYCLE_NS;
    commands_in = n == 1;
    samples_in = every && n % every == 0;
    response.room = 16;
    data_log.room = 64;
    response.sent = data_log.sent = 0;
    scan();
    if (data_log.sent) last = data_log.messages[data_log.sent - 1];
  }
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &b);
  printf("%.9f %d %d %.*s\n", (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec), logged, dropped, last.length,
         last.bytes);
  return 0;
}
