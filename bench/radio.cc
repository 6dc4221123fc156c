// What ns-3's 802.11g ad hoc model carries between two stations, for bench/radio.py, which compiles and runs it.
//
// radio DISTANCE_M EXPONENT POWER_DBM FADING BYTES BOTH SECONDS: prints Mbit/s of UDP payload that arrive. FADING is the shape of
// Nakagami fading, 0 for none; BOTH is 1 where both stations send.
#include "ns3/core-module.h"
#include "ns3/internet-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/wifi-module.h"

#include <cstdlib>
#include <iostream>

using namespace ns3;

namespace
{
const double REFERENCE_LOSS_DB = 46.68;
const double BEGIN_S = 1.0; // addresses are resolved by then
const uint16_t PORT = 9;

// Sends more than the air carries, so that the queue is never empty; what finds it full is dropped there.
void
Send(Ptr<Socket> socket, InetSocketAddress to, uint32_t bytes)
{
    socket->SendTo(Create<Packet>(bytes), 0, to);
    Simulator::Schedule(MicroSeconds(200), &Send, socket, to, bytes);
}

uint64_t received = 0;

void
Receive(Ptr<Socket> socket)
{
    while (Ptr<Packet> packet = socket->Recv())
    {
        received += Simulator::Now().GetSeconds() >= BEGIN_S ? packet->GetSize() : 0;
    }
}
} // namespace

int
main(int argc, char** argv)
{
    if (argc != 8)
    {
        return 2;
    }
    const double distance = std::atof(argv[1]), exponent = std::atof(argv[2]), power = std::atof(argv[3]);
    const double fading = std::atof(argv[4]), seconds = std::atof(argv[7]);
    const uint32_t bytes = std::atoi(argv[5]);
    const bool both = std::atoi(argv[6]) == 1;

    NodeContainer nodes(2);
    YansWifiChannelHelper channel;
    channel.SetPropagationDelay("ns3::ConstantSpeedPropagationDelayModel");
    channel.AddPropagationLoss("ns3::LogDistancePropagationLossModel",
                               "Exponent", DoubleValue(exponent),
                               "ReferenceLoss", DoubleValue(REFERENCE_LOSS_DB));
    if (fading > 0)
    {
        channel.AddPropagationLoss("ns3::NakagamiPropagationLossModel",
                                   "m0", DoubleValue(fading), "m1", DoubleValue(fading), "m2", DoubleValue(fading));
    }
    YansWifiPhyHelper phy;
    phy.SetChannel(channel.Create());
    phy.Set("TxPowerStart", DoubleValue(power));
    phy.Set("TxPowerEnd", DoubleValue(power));
    WifiMacHelper mac;
    mac.SetType("ns3::AdhocWifiMac");
    WifiHelper wifi;
    wifi.SetStandard(WIFI_STANDARD_80211g);
    wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager",
                                 "DataMode", StringValue("ErpOfdmRate24Mbps"),
                                 "ControlMode", StringValue("ErpOfdmRate24Mbps"));
    NetDeviceContainer devices = wifi.Install(phy, mac, nodes);

    auto places = CreateObject<ListPositionAllocator>();
    places->Add(Vector(0, 0, 0));
    places->Add(Vector(distance, 0, 0));
    MobilityHelper mobility;
    mobility.SetPositionAllocator(places);
    mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel");
    mobility.Install(nodes);

    InternetStackHelper internet;
    internet.Install(nodes);
    Ipv4AddressHelper addresses;
    addresses.SetBase("10.0.0.0", "255.255.255.0");
    Ipv4InterfaceContainer interfaces = addresses.Assign(devices);
    NeighborCacheHelper neighbours; // a lost ARP packet is not what is compared
    neighbours.PopulateNeighborCache();

    const auto udp = TypeId::LookupByName("ns3::UdpSocketFactory");
    for (uint32_t end = 0; end < 2; ++end)
    {
        auto socket = Socket::CreateSocket(nodes.Get(end), udp);
        socket->Bind(InetSocketAddress(Ipv4Address::GetAny(), PORT));
        socket->SetRecvCallback(MakeCallback(&Receive));
        if (end == 0 || both)
        {
            Simulator::Schedule(Seconds(0.1), &Send, socket, InetSocketAddress(interfaces.GetAddress(1 - end), PORT), bytes);
        }
    }
    Simulator::Stop(Seconds(BEGIN_S + seconds));
    Simulator::Run();
    std::cout << received * 8 / seconds / 1e6 << std::endl;
    Simulator::Destroy();
    return 0;
}
