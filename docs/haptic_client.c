/* A haptic device for naibu live --haptics-port 8766. Build: cc -O2 haptic_client.c -o haptic_client -lm (POSIX, little-endian).
   read_device and set_force stand for the device's own library. The tool turns as the quaternion does, which is constant here. */
#include <arpa/inet.h>
#include <errno.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

struct pose {
    char magic[4]; uint16_t version, buttons; uint32_t sequence, applied;
    double time_s, position_mm[3], quaternion[4], energy_mn_mm;
};
struct force {
    char magic[4]; uint16_t version, flags; uint32_t number, sequence;
    double time_s, force_mn[3], torque_mn_mm[3], energy_mn_mm;
};
_Static_assert(sizeof(struct pose) == 88 && sizeof(struct force) == 80, "the packets have no padding");

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void read_device(double t, struct pose *p) { p->position_mm[2] = -25.0 * fmin(t / 2.0, 1.0); p->quaternion[0] = 1.0; }
static void set_force(const double f[3]) { (void)f; }
static double dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

int main(int argc, char **argv)
{
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons((uint16_t)(argc > 1 ? atoi(argv[1]) : 8766))};
    double seconds = argc > 2 ? atof(argv[2]) : 10.0, began = now(), due, heard = began;
    struct pose out = {.magic = "NHP1", .version = 2};
    struct force in, last = {.number = 0};
    double f[3] = {0}, moved[3] = {0}, work, left;
    uint32_t free_since = 0;                                                 /* first pose that said that no force acts */
    uint32_t ready = 0;                                                      /* first pose after naibu had been prepared */
    int line = socket(AF_INET, SOCK_DGRAM, 0), answers = 0, acts = 0;
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (line < 0 || connect(line, (struct sockaddr *)&to, sizeof to)) { perror("naibu"); return 1; }
    while (out.sequence - ready < 1e3 * seconds || (answers && !ready)) {
        while (recv(line, &in, sizeof in, MSG_DONTWAIT) == (ssize_t)sizeof in)
            if (!memcmp(in.magic, "NHF1", 4) && in.version == 2
                && (acts ? (int32_t)(in.number - last.number) > 0 : (int32_t)(in.sequence - free_since) >= 0)) {
                if (answers == 0 && in.flags & 16) puts("naibu is being prepared");
                if (!ready && !(in.flags & 16)) ready = out.sequence;  /* flag 16: naibu waits, and exerts no force */
                last = in; acts = 1; heard = now(); answers++;         /* dropped: overtaken answers, and those made before letting go */
            }
        if (acts && now() - heard > 0.02) { acts = 0; free_since = out.sequence + 1; }          /* no answer: let go */
        work = dot(last.force_mn, moved);                       /* energy of the next millisecond, if the device goes on as it went */
        left = fmax(last.energy_mn_mm - out.energy_mn_mm, 0.0);                                   /* what it may still get */
        for (int a = 0; a < 3; a++) f[a] = acts ? last.force_mn[a] * (work > left ? left / work : 1.0) : 0.0;
        set_force(f);
        out.sequence++;
        out.applied = acts ? last.number : 0;                                       /* the answer whose force acts */
        out.time_s = now() - began;
        memcpy(moved, out.position_mm, sizeof moved);
        read_device(ready ? 1e-3 * (out.sequence - ready) : 0.0, &out);
        for (int a = 0; a < 3; a++) moved[a] = out.position_mm[a] - moved[a];
        out.energy_mn_mm += dot(f, moved);                                          /* the device's account of what it got */
        if (send(line, &out, sizeof out, 0) < 0 && errno != ECONNREFUSED) { perror("naibu"); return 1; }
        due = began + 1e-3 * out.sequence;
        struct timespec rest = {0, (long)(1e9 * fmax(0.0, due - now()))};
        nanosleep(&rest, NULL);
    }
    printf("%u poses, %d answers, last force %.1f %.1f %.1f mN, flags %u\n", out.sequence - ready, answers, last.force_mn[0],
           last.force_mn[1], last.force_mn[2], (unsigned)last.flags);
    close(line);
    return 0;
}
